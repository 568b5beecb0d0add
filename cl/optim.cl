// optim.cl: fused Adam (Kingma & Ba 2015) over component-major buffers, the skew map, regularisers, MCMC noise,
// and the one kernel that moves splats about. The NumPy forms are in clsplat/optim_reference.py, skew_map.py and
// noise.py; a test compares them step for step.

static inline vreal adam_direction(vreal grad, global real *m_at, global real *v_at, real correct1, real correct2) {
    const vreal m = lanes_load(m_at) * ADAM_BETA1 + grad * ((real)1 - ADAM_BETA1);
    const vreal v = lanes_load(v_at) * ADAM_BETA2 + grad * grad * ((real)1 - ADAM_BETA2);
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

#ifdef ROW_SKEW
// The trainable skew s [3, capacity] and the kernel's m = s/|s| f(|s|):
// SKEW_MAP 0 ("cube-root"): f = SKEW_MAX tanh(|s|)^(1/3); 1 ("linear"): f = SKEW_MAX tanh(|s|).
#define SKEW_FLOOR R(1e-6)

static inline vreal skew_radius(vreal s) {
#if SKEW_MAP == 0
    return SKEW_MAX * cbrt(tanh(s));
#else
    return SKEW_MAX * tanh(s);
#endif
}
static inline vreal skew_radius_derivative(vreal s, vreal f) {
    const vreal th = tanh(s);
#if SKEW_MAP == 0
    return f * ((vreal)1 - th * th) / ((real)3 * th);
#else
    return SKEW_MAX * ((vreal)1 - th * th);
#endif
}

static inline vec3 skew_map(vec3 s) {
    const vreal norm = max(sqrt(dot3(s, s)), (vreal)SKEW_FLOOR);
    return scale3(s, skew_radius(norm) / norm);
}

// One Adam step on s (rows ROW_SKEW of the moments), with the chain rule from the gradient of m, then m anew.
kernel void adam_step_skew(
    global real *restrict skew_s,
    global real *restrict geom,
    global const real *restrict grad_geom,
    global real *restrict adam_m,
    global real *restrict adam_v,
    ulong capacity,
    real lr,
    real correct1,
    real correct2)
{
    const ulong i = get_global_id(0) * LANES, at = i + ROW_SKEW * capacity;
    vec3 s = vec3_load(skew_s + i, capacity);
    const vec3 v_m = vec3_load(grad_geom + at, capacity);
    const vreal norm = max(sqrt(dot3(s, s)), (vreal)SKEW_FLOOR), inv = (vreal)1 / norm;
    const vec3 unit = scale3(s, inv);
    const vreal f = skew_radius(norm), radial = dot3(unit, v_m);
    const vreal across = f * inv;
    const vec3 v_s = add3(scale3(v_m, across), scale3(unit, radial * (skew_radius_derivative(norm, f) - across)));
    s.x -= lr * adam_direction(v_s.x, adam_m + at, adam_v + at, correct1, correct2);
    s.y -= lr * adam_direction(v_s.y, adam_m + at + capacity, adam_v + at + capacity, correct1, correct2);
    s.z -= lr * adam_direction(v_s.z, adam_m + at + 2 * capacity, adam_v + at + 2 * capacity, correct1, correct2);
    vec3_store(s, skew_s + i, capacity);
    vec3_store(skew_map(s), geom + at, capacity);
}
#endif

// Adds the gradients of opacity_scale * sum(opacity) + scale_scale * sum(scale) (3DGS-MCMC's regularisers).
kernel void regularise(
    global const real *restrict geom,
    global real *restrict grad_geom,
    ulong capacity,
    real opacity_scale,
    real scale_scale)
{
    const ulong i = get_global_id(0) * LANES;
    const ulong at = i + ROW_OPACITY_LOGIT * capacity;
    const vreal o = (vreal)1 / ((vreal)1 + exp(-lanes_load(geom + at)));
    lanes_store(lanes_load(grad_geom + at) + opacity_scale * o * ((vreal)1 - o), grad_geom + at);
    for (int c = 0; c < 3; ++c) {
        const ulong to = i + (ROW_LOG_SCALE + c) * capacity;
        lanes_store(lanes_load(grad_geom + to) + scale_scale * exp(lanes_load(geom + to)), grad_geom + to);
    }
}

// Philox4x32-10 (Salmon et al. 2011): counter-based, so noise depends on (seed, iteration, splat) alone. One counter
// a lane; key the same for all.
static inline void philox(vuint *c, uint2 key) {
    for (int round = 0; round < 10; ++round) {
        const vuint hi0 = mul_hi((vuint)0xD2511F53u, c[0]), lo0 = (vuint)0xD2511F53u * c[0];
        const vuint hi1 = mul_hi((vuint)0xCD9E8D57u, c[2]), lo1 = (vuint)0xCD9E8D57u * c[2];
        c[0] = hi1 ^ c[1] ^ (vuint)key.x;
        c[1] = lo1;
        c[2] = hi0 ^ c[3] ^ (vuint)key.y;
        c[3] = lo0;
        key += (uint2)(0x9E3779B9u, 0xBB67AE85u);
    }
}

// The top 23 bits at the centre of their interval, in (0, 1).
static inline vreal uniform_of(vuint word) {
    return (lanes_uint_to_real(word >> 9) + (vreal)R(0.5)) * (vreal)(real)(1.0 / 8388608.0);
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
    const vreal o = (vreal)1 / ((vreal)1 + exp(-lanes_load(at + ROW_OPACITY_LOGIT * capacity)));
    const vreal gate = (vreal)amount / ((vreal)1 + exp((real)100 * o - (vreal)R(0.5)));
    uint index[LANES];
    for (int l = 0; l < LANES; ++l) index[l] = first + l;
    vuint words[4] = {lanes_load(index), (vuint)iteration, (vuint)0, (vuint)0};
    philox(words, (uint2)(seed_lo, seed_hi));
    const vreal two_pi = (vreal)R(6.28318530717958647692);
    const vreal radius01 = sqrt(R(-2.0) * log(uniform_of(words[0]))), angle01 = two_pi * uniform_of(words[1]);
    const vreal radius2 = sqrt(R(-2.0) * log(uniform_of(words[2]))), angle2 = two_pi * uniform_of(words[3]);
    const vec3 step = scale3((vec3){radius01 * cos(angle01), radius01 * sin(angle01), radius2 * cos(angle2)}, gate);
    const mat3 rotation = quat_rotation(quat_load(at + ROW_QUAT * capacity, capacity));
    const vec3 ls = vec3_load(at + ROW_LOG_SCALE * capacity, capacity);
    const vec3 variance = {exp((real)2 * ls.x), exp((real)2 * ls.y), exp((real)2 * ls.z)};
    const vec3 moved = mat3_apply(rotation, mul3(mat3_apply_transposed(rotation, step), variance));
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
