"""From graphs to ONNX models: each piece of a program, the whole call as one file, eight-bit blocks.

What has no form in ONNX is a ``LoweringError`` of any function of this room.
"""
