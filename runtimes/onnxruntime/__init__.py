"""The product on the CPU: numpy and onnxruntime."""
