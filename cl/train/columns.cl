// columns.cl: kernels that move splats between columns of a buffer [rows, capacity].

// moved[row, i] = values[row, source[i]]. Global size: (at least n, rows).
kernel void gather_columns(
    global const real *restrict values,
    global const int *restrict source,
    global real *restrict moved,
    ulong capacity,
    uint n
) {
    const ulong i = get_global_id(0), row = get_global_id(1) * capacity;
    if (i < n) moved[row + i] = values[row + source[i]];
}

// values[row, i] = 0 where fresh[i]. Global size: (at least n, rows).
kernel void zero_columns(global real *restrict values, global const uchar *restrict fresh, ulong capacity, uint n) {
    const ulong i = get_global_id(0);
    if (i < n && fresh[i]) values[get_global_id(1) * capacity + i] = 0;
}
