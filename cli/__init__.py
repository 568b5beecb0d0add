"""The clsplat command line: each module parses flags, calls one library function, prints."""
