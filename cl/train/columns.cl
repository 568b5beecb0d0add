// columns.cl: kernels that move splats between columns of buffers [rows, capacity], and add them up.

// moved[row, i] = values[first + row, source[i]]; a row of `moved` has `width` columns. Global size: (at least n, rows).
kernel void gather_columns(
    global const real *restrict values,
    global const int *restrict source,
    global real *restrict moved,
    ulong capacity,
    ulong width,
    uint first,
    uint n
) {
    const ulong i = get_global_id(0), row = get_global_id(1);
    if (i < n) moved[row * width + i] = values[(first + row) * capacity + source[i]];
}

// values[first + row, target[i]] = moved[row, i] for n different targets; moved [rows, n]. Global size: (at least n, rows).
kernel void scatter_columns(
    global const real *restrict moved,
    global const int *restrict target,
    global real *restrict values,
    ulong capacity,
    uint first,
    uint n
) {
    const ulong i = get_global_id(0), row = get_global_id(1);
    if (i < n) values[(first + row) * capacity + target[i]] = moved[row * n + i];
}

// values[row, i] = 0 where fresh[i]. Global size: (at least n, rows).
kernel void zero_columns(global real *restrict values, global const uchar *restrict fresh, ulong capacity, uint n) {
    const ulong i = get_global_id(0);
    if (i < n && fresh[i]) values[get_global_id(1) * capacity + i] = 0;
}

// sum[first + row, i] += factor * addend[from + row, i], or without `adds` the product alone. Global size: (at least n, rows).
kernel void add_columns(
    global real *restrict sum,
    global const real *restrict addend,
    ulong capacity,
    uint first,
    uint from,
    uint n,
    real factor,
    uint adds
) {
    const ulong i = get_global_id(0), row = get_global_id(1);
    if (i >= n) return;
    const ulong at = (first + row) * capacity + i;
    const real term = factor * addend[(from + row) * capacity + i];
    sum[at] = adds ? sum[at] + term : term;
}
