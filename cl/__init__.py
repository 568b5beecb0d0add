"""OpenCL C sources of clsplat, read as package data by clsplat.device.program."""
