// density.cl: what densification must know of every splat (clsplat/training/density/table.py).

// Adds zero times each of some rows of splat i: the sum is NaN if one of them is not finite, else zero.
static inline real zero_if_finite(global const real *restrict rows, uint count, ulong capacity, uint i) {
    real zero = 0;
    for (uint row = 0; row < count; ++row) zero += 0 * rows[row * capacity + i];
    return zero;
}

// Writes the largest log scale and the largest raw opacity of each splat (signed shapes: of its absolute value). Both are NaN
// if a parameter is not finite or the position is out of bounds. summary [2, n]. Global size: at least n.
kernel void summarise_splats(
    global const real *restrict geom,
    global const real *restrict sh,
    global real *restrict summary,
    ulong capacity,
    uint n
) {
    const uint i = get_global_id(0);
    if (i >= n) return;
    real zero = zero_if_finite(geom, GEOM_ROWS, capacity, i) + zero_if_finite(sh, SH_ROWS, capacity, i);
    real farthest = 0, size = geom[ROW_LOG_SCALE * capacity + i];
    for (uint c = 0; c < 3; ++c) farthest = max(farthest, fabs(geom[(ROW_MEAN + c) * capacity + i]));
    for (uint c = 1; c < 3; ++c) size = max(size, geom[(ROW_LOG_SCALE + c) * capacity + i]);
    real opacity = geom[ROW_OPACITY_LOGIT * capacity + i];
#ifdef ROW_OPACITY_MINUS_LOGIT
    const real other = geom[ROW_OPACITY_MINUS_LOGIT * capacity + i];
#else
    const real other = opacity;
#endif
#if OPACITY_SIGNED
    opacity = max(fabs(opacity), fabs(other));
#else
    opacity = max(opacity, other);
#endif
    const bool sound = zero == 0 && farthest <= MAX_COORDINATE;
    summary[i] = sound ? size : (real)NAN;
    summary[n + i] = sound ? opacity : (real)NAN;
}
