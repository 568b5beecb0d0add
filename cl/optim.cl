// optim.cl: fused Adam (Kingma & Ba 2015) over component-major buffers, SGHMC for positions, the skew map's chain rule,
// regularisers, MCMC noise, and the kernels that move splats about. The NumPy forms are in clsplat/optim_host.py,
// optim_reference.py, sghmc.py, skew_map.py and noise.py; a test compares them step for step.

static inline vreal adam_direction(vreal grad, global real *m_at, global real *v_at, real correct1, real correct2) {
    const vreal m = lanes_load(m_at) * ADAM_BETA1 + grad * ADAM_REST1;
    const vreal v = lanes_load(v_at) * ADAM_BETA2 + grad * grad * ADAM_REST2;
    lanes_store(m, m_at);
    lanes_store(v, v_at);
    return m * correct1 / (sqrt(v * correct2) + (vreal)ADAM_EPS);
}

// value, m, v [rows, capacity] in place; lr [rows]. correct1, correct2 = 1 / (1 - beta^step).
// Global size: (capacity / LANES, rows to update).
kernel void adam_step(
    global real *restrict value,
    global const real *restrict grad,
    global real *restrict adam_m,
    global real *restrict adam_v,
    constant real *restrict lr,
    ulong capacity,
    uint first_row,
    real correct1,
    real correct2)
{
    const ulong row = first_row + get_global_id(1);
    const ulong at = row * capacity + get_global_id(0) * LANES;
    const vreal step = adam_direction(lanes_load(grad + at), adam_m + at, adam_v + at, correct1, correct2);
    lanes_store(lanes_load(value + at) - lr[row] * step, value + at);
}

// The same on the logarithm of one row of positive values, which stays within its bounds.
kernel void adam_step_bounded(
    global real *restrict value,
    global const real *restrict grad,
    global real *restrict adam_m,
    global real *restrict adam_v,
    ulong capacity,
    uint row,
    real lr,
    real low,
    real high,
    real correct1,
    real correct2)
{
    const ulong at = row * capacity + get_global_id(0) * LANES;
    const vreal old = lanes_load(value + at);
    const vreal step = adam_direction(lanes_load(grad + at) * old, adam_m + at, adam_v + at, correct1, correct2);
    lanes_store(lanes_clamp(old * exp(-lr * step), low, high), value + at);
}

// One step of the means with momentum [3, capacity]: clsplat/sghmc.py has the formula and the coefficients.
kernel void sghmc_step(
    global real *restrict geom,
    global const real *restrict grad_geom,
    global real *restrict adam_m,
    global real *restrict adam_v,
    global real *restrict momentum,
    ulong capacity,
    uint n_splats,
    uint seed_lo,
    uint seed_hi,
    uint iteration,
    uint stream,
    real correct1,
    real correct2,
    real length,
    real drive,
    real keep,
    real noise,
    uint by_covariance)
{
    const uint first = get_global_id(0) * LANES;
    if (first >= n_splats) return;
    global real *at = geom + first;
    const vreal gate = noise_gate(at, capacity);
    vec3 spread = normal3(first, (uint2)(seed_lo, seed_hi), iteration, stream);
    if (by_covariance) spread = covariance_times(at, capacity, spread);
    const vreal random[3] = {spread.x, spread.y, spread.z};
    for (int c = 0; c < 3; ++c) {
        const ulong row = (ROW_MEAN + c) * capacity + first, own = c * capacity + first;
        const vreal g = adam_direction(lanes_load(grad_geom + row), adam_m + row, adam_v + row, correct1, correct2);
        const vreal p = gate * (keep * lanes_load(momentum + own) + noise * random[c]) - drive * g;
        lanes_store(p, momentum + own);
        lanes_store(lanes_load(geom + row) + length * p, geom + row);
    }
}

#ifdef ROW_SKEW
// The gradient v_s of the trainable skew, from that of the kernel's; adds to the rotation's where the map depends on it.
kernel void skew_map_vjp(
    global const real *restrict skew_s,
    global const real *restrict geom,
    global real *restrict grad_geom,
    global real *restrict v_s,
    ulong capacity)
{
    const ulong i = get_global_id(0) * LANES;
    vec3 v = vec3_load(grad_geom + i + ROW_SKEW * capacity, capacity);
#if SKEW_ROTATES
    const unit_quat q = quat_load(geom + i + ROW_QUAT * capacity, capacity);
    const vec3 a = skew_of(skew_s + i, capacity);
    global real *to = grad_geom + i + ROW_QUAT * capacity;
    vreal others[4];
    for (int c = 0; c < 4; ++c) others[c] = lanes_load(to + c * capacity);
    quat_rotation_vjp(q, (mat3){scale3(v, a.x), scale3(v, a.y), scale3(v, a.z)}, lanes_mask(1), to, capacity);
    for (int c = 0; c < 4; ++c) lanes_store(lanes_load(to + c * capacity) + others[c], to + c * capacity);
    v = mat3_apply(quat_rotation(q), v);
#endif
    skew_of_vjp(skew_s + i, v, v_s + i, capacity);
}

// The kernel's skew anew.
kernel void skew_map(global const real *restrict skew_s, global real *restrict geom, ulong capacity)
{
    const ulong i = get_global_id(0) * LANES;
    vec3 skew = skew_of(skew_s + i, capacity);
#if SKEW_ROTATES
    const mat3 rotation = quat_rotation(quat_load(geom + i + ROW_QUAT * capacity, capacity));
    skew = mat3_apply_transposed(rotation, skew);
#endif
    vec3_store(skew, geom + i + ROW_SKEW * capacity, capacity);
}
#endif

// Adds the gradients of opacity_scale * sum(|opacity|) + scale_scale * sum(scale) (3DGS-MCMC's regularisers) and, where
// a splat has two opacities, whose mean counts then, of bisect_scale * sum((one - other)^2) (3DSGS).
kernel void regularise(
    global const real *restrict geom,
    global real *restrict grad_geom,
    ulong capacity,
    real opacity_scale,
    real scale_scale,
    real bisect_scale)
{
    const ulong i = get_global_id(0) * LANES;
    const ulong at = i + ROW_OPACITY_LOGIT * capacity;
    const vreal o = opacity_of(lanes_load(geom + at));
    vreal v_o = opacity_scale * sign(o);
#ifdef ROW_OPACITY_MINUS_LOGIT
    const ulong at_minus = i + ROW_OPACITY_MINUS_LOGIT * capacity;
    const vreal o_minus = opacity_of(lanes_load(geom + at_minus)), gap = (real)2 * bisect_scale * (o - o_minus);
    const vreal v_minus = (real)0.5 * opacity_scale * sign(o_minus) - gap;
    v_o = (real)0.5 * v_o + gap;
    lanes_store(lanes_load(grad_geom + at_minus) + v_minus * opacity_slope(o_minus), grad_geom + at_minus);
#endif
    lanes_store(lanes_load(grad_geom + at) + v_o * opacity_slope(o), grad_geom + at);
    for (int c = 0; c < 3; ++c) {
        const ulong to = i + (ROW_LOG_SCALE + c) * capacity;
        lanes_store(lanes_load(grad_geom + to) + scale_scale * exp(lanes_load(geom + to)), grad_geom + to);
    }
}

// mean += Sigma (xi gate amount), Sigma = R S S R', gate = sigmoid(0.5 - 100 opacity) (3DGS-MCMC, Kheradmand 2024).
kernel void mcmc_noise(
    global real *restrict geom,
    ulong capacity,
    uint n_splats,
    uint seed_lo,
    uint seed_hi,
    uint iteration,
    real amount)
{
    const uint first = get_global_id(0) * LANES;
    if (first >= n_splats) return;
    global real *at = geom + first;
    const vreal gate = amount * noise_gate(at, capacity);
    const vec3 step = scale3(normal3(first, (uint2)(seed_lo, seed_hi), iteration, 0), gate);
    const vec3 moved = covariance_times(at, capacity, step);
    vec3_store(add3(vec3_load(at + ROW_MEAN * capacity, capacity), moved), at + ROW_MEAN * capacity, capacity);
}

// moved[row, i] = values[row, source[i]]. Global size: (at least n, rows).
kernel void gather_columns(
    global const real *restrict values,
    global const int *restrict source,
    global real *restrict moved,
    ulong capacity,
    uint n)
{
    const ulong i = get_global_id(0), row = get_global_id(1) * capacity;
    if (i < n) moved[row + i] = values[row + source[i]];
}

// values[row, i] = 0 where fresh[i]. Global size: (at least n, rows).
kernel void zero_columns(
    global real *restrict values,
    global const uchar *restrict fresh,
    ulong capacity,
    uint n)
{
    const ulong i = get_global_id(0);
    if (i < n && fresh[i]) values[get_global_id(1) * capacity + i] = 0;
}
