"""OpenCL devices, programs and memory."""
