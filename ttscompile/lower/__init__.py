"""From graphs to ONNX models: each piece of a program, the whole call as one file, eight-bit blocks."""
