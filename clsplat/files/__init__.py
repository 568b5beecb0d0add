"""Files that know no splats."""
