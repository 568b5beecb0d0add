"""The clsplat command line. Each module parses flags, calls one library function and prints its result."""
