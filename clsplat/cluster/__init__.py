"""Jobs on several processes or machines, through a scheduler of dask.distributed (extra `cluster`)."""
