"""Files and formats that do not depend on splats."""
