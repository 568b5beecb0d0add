// optim.cl: one step of all parameters, or of those of splats that were seen: Adam with regularisers and the skew map's chain
// rule; SGHMC for positions, MCMC noise, and the kernels that move splats about. The NumPy forms are in
// clsplat/training/optim/reference.py, optim_reference.py, optim_lazy.py, regularisers.py, sghmc.py, skew_map.py and noise.py; a test
// compares them step for step.

// Coefficient k of the colour. grad_sh [6, capacity]: the gradient of the colour and the direction (cl/render/project.cl), whose
// product with the basis is formed here.
static inline void step_coefficient(
    uint k,
    int degree,
    real lr,
    global real *sh,
    global const real *grad_sh,
    adam_moments adam,
    const ulong capacity
) {
    vreal basis[SH_COUNT];
    sh_basis(vec3_load(grad_sh + 3 * capacity, capacity), degree, basis);
    for (int c = 0; c < 3; ++c)
        adam_step(basis[k] * lanes_load(grad_sh + c * capacity), lr, sh, adam, (3 * k + c) * capacity);
}

// Parts that a step of geometry is shared out in: each reads its own rows and writes them, so that few streams of memory
// are open at a time. The skew goes with the rotation where its map depends on it.
#define PART_MEAN 0
#define PART_QUAT 1
#define PART_SCALE 2
#define PART_OWN 3  // opacities, and the shape's own but the skew
#define PART_SKEW 4
#define PARTS 5  // then one a coefficient of the colour
#ifdef ROW_SKEW
#define PART_MAPS (SKEW_ROTATES ? PART_QUAT : PART_SKEW)  // has the trainable skew
#endif

// Rows of a part, skew left out.
static inline uint2 part_rows(uint part) {
    switch (part) {
    case PART_MEAN:
        return (uint2)(ROW_MEAN, ROW_MEAN + 3);
    case PART_QUAT:
        return (uint2)(ROW_QUAT, ROW_QUAT + 4);
    case PART_SCALE:
        return (uint2)(ROW_LOG_SCALE, ROW_LOG_SCALE + 3);
#ifdef ROW_SKEW
    case PART_OWN:
        return (uint2)(ROW_OPACITY_LOGIT, ROW_SKEW);
#else
    case PART_OWN:
        return (uint2)(ROW_OPACITY_LOGIT, GEOM_ROWS);
#endif
    default:
        return (uint2)(0, 0);
    }
}
#define PART_ROWS 4  // at most

// Steps that were sat out, of a coefficient of the colour, of a part's rows, and of the trainable skew.
static inline void
catch_up_coefficient(uint k, adam_wait wait, real lr, global real *sh, adam_moments adam, const ulong capacity) {
    for (int c = 0; c < 3; ++c) adam_catch_up(wait, lr, 0, 0, sh, adam, (3 * k + c) * capacity);
}
static inline void catch_up_rows(
    uint2 rows,
    constant real *waits,
    int steps,
    bool keeps_moments,
    global real *geom,
    adam_moments adam,
    constant real *rates,
    const ulong capacity
) {
    const bool means = rows.x == ROW_MEAN;
    const adam_wait wait = waited_steps(waits, steps, means ? DRIFT_MEAN : DRIFT, keeps_moments);
    for (uint row = rows.x; row < rows.y; ++row)
        adam_catch_up(
            wait, means ? (real)1 : rates[row], rates[GEOM_ROWS + row], rates[2 * GEOM_ROWS + row], geom, adam,
            row * capacity
        );
}
#ifdef ROW_SKEW
static inline void catch_up_skew(
    constant real *waits,
    int steps,
    bool keeps_moments,
    real lr,
    global real *skew_s,
    adam_moments adam,
    const ulong capacity
) {
    const adam_wait wait = waited_steps(waits, steps, DRIFT_SKEW, keeps_moments);
    for (int row = 0; row < SKEW_WIDTH; ++row) adam_catch_up(wait, lr, 0, 0, skew_s, adam, row * capacity);
}

// The kernel's skew from the trainable one, and from the rotation where the map looks at it.
static inline void map_skew(global real *geom, global const real *skew_s, const ulong capacity) {
    vec3 skew = skew_of(skew_s, capacity);
#if SKEW_ROTATES
    skew = mat3_apply_transposed(quat_rotation(quat_load(geom + ROW_QUAT * capacity, capacity)), skew);
#endif
    vec3_store(skew, geom + ROW_SKEW * capacity, capacity);
}
#endif

// Adds to g, the gradients of a part's rows, those of opacity_scale * sum(|opacity|) + scale_scale * sum(scale)
// (3DGS-MCMC's regularisers) and, where a splat has two opacities, whose mean counts then, of
// bisect_scale * sum((one - other)^2) (3DSGS).
static inline void regularise(
    uint part,
    vreal *g,
    global const real *geom,
    const ulong capacity,
    real opacity_scale,
    real scale_scale,
    real bisect_scale
) {
    if (part == PART_SCALE)
        for (int c = 0; c < 3; ++c) g[c] += scale_scale * exp(lanes_load(geom + (ROW_LOG_SCALE + c) * capacity));
    if (part == PART_OWN) {
        const vreal o = opacity_of(lanes_load(geom + ROW_OPACITY_LOGIT * capacity));
        vreal v_o = opacity_scale * sign(o);
#ifdef ROW_OPACITY_MINUS_LOGIT
        const vreal o_minus = opacity_of(lanes_load(geom + ROW_OPACITY_MINUS_LOGIT * capacity));
        const vreal gap = (real)2 * bisect_scale * (o - o_minus);
        const vreal v_minus = (real)0.5 * opacity_scale * sign(o_minus) - gap;
        v_o = (real)0.5 * v_o + gap;
        g[ROW_OPACITY_MINUS_LOGIT - ROW_OPACITY_LOGIT] += v_minus * opacity_slope(o_minus);
#endif
        g[0] += v_o * opacity_slope(o);
    }
}

// One step of all parameters but the means that SGHMC moves (then means_learn is 0): geom, sh and their moments in place.
// grad_geom may change where the skew's map depends on the rotation. rates [3, GEOM_ROWS]: the rate (of the means
// mean_lr instead), and the bounds of what is stepped in the logarithm (0, 0 without). The skew follows the trainable one,
// skew_s with skew_m, skew_v [SKEW_WIDTH, capacity] (of any content in shapes without), which learns if skew_learns; all
// else learns if base_learns. Parts from `lazy_from` on are stepped only in vectors of splats that wake_vectors woke, after
// the steps that they sat out (ages, waits: not looked at if there is no such part).
// Global size: (capacity / LANES, PARTS + coefficients of the degree).
kernel void step_splats(
    global real *restrict geom,
    global real *restrict grad_geom,
    global real *restrict geom_m,
    global real *restrict geom_v,
    global real *restrict sh,
    global const real *restrict grad_sh,
    global real *restrict sh_m,
    global real *restrict sh_v,
    global real *restrict skew_s,
    global real *restrict skew_m,
    global real *restrict skew_v,
    constant real *restrict rates,
    global const int2 *restrict ages,
    constant real *restrict waits,
    uint lazy_from,
    ulong capacity,
    int sh_degree,
    uint base_learns,
    uint means_learn,
    uint skew_learns,
    real mean_lr,
    real sh_lr,
    real sh_rest_lr,
    real skew_lr,
    real correct1,
    real correct2,
    real skew_correct1,
    real skew_correct2,
    real opacity_scale,
    real scale_scale,
    real bisect_scale
) {
    const ulong i = get_global_id(0) * LANES;
    const uint part = get_global_id(1);
    int2 age = (int2)(0, 0);
    if (part >= lazy_from) {
        age = ages[get_global_id(0)];
        if (age.x < 0) return;
    }
    if (part >= PARTS) {
        const adam_moments adam = {sh_m + i, sh_v + i, correct1, correct2};
        const uint k = part - PARTS;
        const real lr = k == 0 ? sh_lr : sh_rest_lr;
        if (age.x > 0) catch_up_coefficient(k, waited_steps(waits, age.x, DRIFT, false), lr, sh + i, adam, capacity);
        if (base_learns) step_coefficient(k, sh_degree, lr, sh + i, grad_sh + i, adam, capacity);
        return;
    }
    geom += i;
    grad_geom += i;
    const uint2 rows = part_rows(part);
    const adam_moments adam = {geom_m + i, geom_v + i, correct1, correct2};
    if (age.x > 0) catch_up_rows(rows, waits, age.x, false, geom, adam, rates, capacity);
    vreal g[PART_ROWS];
    for (uint row = rows.x; row < rows.y; ++row) g[row - rows.x] = lanes_load(grad_geom + row * capacity);
    if (opacity_scale > 0 || scale_scale > 0 || bisect_scale > 0)
        regularise(part, g, geom, capacity, opacity_scale, scale_scale, bisect_scale);
#ifdef ROW_SKEW
    const adam_moments adam_s = {skew_m + i, skew_v + i, skew_correct1, skew_correct2};
    if (age.y > 0 && part == PART_MAPS) catch_up_skew(waits, age.y, false, skew_lr, skew_s + i, adam_s, capacity);
    const bool maps = part == PART_MAPS && (skew_learns || SKEW_ROTATES || age.y > 0);
    vreal v_s[SKEW_WIDTH];
    if (maps) {
        vec3 v = vec3_load(grad_geom + ROW_SKEW * capacity, capacity);
#if SKEW_ROTATES
        const unit_quat q = quat_load(geom + ROW_QUAT * capacity, capacity);
        const vec3 a = skew_of(skew_s + i, capacity);
        global real *v_quat = grad_geom + ROW_QUAT * capacity;
        quat_rotation_vjp(q, (mat3){scale3(v, a.x), scale3(v, a.y), scale3(v, a.z)}, lanes_mask(1), v_quat, capacity);
        for (int c = 0; c < 4; ++c) g[c] += lanes_load(v_quat + c * capacity);
        v = mat3_apply(quat_rotation(q), v);
#endif
        skew_of_vjp(skew_s + i, v, v_s, capacity);
    }
#endif
    if (part == PART_MEAN ? means_learn : base_learns)
        for (uint row = rows.x; row < rows.y; ++row) {
            const real lr = part == PART_MEAN ? mean_lr : rates[row];
            const real low = rates[GEOM_ROWS + row], high = rates[2 * GEOM_ROWS + row];
            if (high > 0) adam_step_bounded(g[row - rows.x], lr, low, high, geom, adam, row * capacity);
            else adam_step(g[row - rows.x], lr, geom, adam, row * capacity);
        }
#ifdef ROW_SKEW
    if (!maps) return;
    if (skew_learns)
        for (int row = 0; row < SKEW_WIDTH; ++row) adam_step(v_s[row], skew_lr, skew_s + i, adam_s, row * capacity);
    map_skew(geom, skew_s + i, capacity);
#endif
}

// One step of the means with momentum [3, capacity]: clsplat/training/optim/sghmc.py has the formula and the coefficients.
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
    uint by_covariance
) {
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

// mean += Sigma (xi gate amount), Sigma = R S S R', gate = sigmoid(0.5 - 100 opacity) (3DGS-MCMC, Kheradmand 2024), but by
// `reach` at most: of a splat as large as the scene a step would lead out of it for good.
kernel void mcmc_noise(
    global real *restrict geom,
    ulong capacity,
    uint n_splats,
    uint seed_lo,
    uint seed_hi,
    uint iteration,
    real amount,
    real reach
) {
    const uint first = get_global_id(0) * LANES;
    if (first >= n_splats) return;
    global real *at = geom + first;
    const vreal gate = amount * noise_gate(at, capacity);
    const vec3 step = scale3(normal3(first, (uint2)(seed_lo, seed_hi), iteration, 0), gate);
    vec3 moved = covariance_times(at, capacity, step);
    moved = scale3(moved, min((vreal)1, reach / sqrt(max(dot3(moved, moved), (vreal)R(1e-30)))));
    vec3_store(add3(vec3_load(at + ROW_MEAN * capacity, capacity), moved), at + ROW_MEAN * capacity, capacity);
}

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
