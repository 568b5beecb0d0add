// optim.cl: one Adam step of colour, geometry and skew, with regularisers and the chain rule of the skew map.
// The NumPy form is clsplat/training/optim/reference.py; a test compares both after each step.
// All buffers are [rows, capacity] with one column for each splat. A work-item steps LANES splats.

// Steps coefficient k of the colour with rate lr. grad_sh [6, capacity] holds the gradient of the colour and the view direction
// (cl/render/project.cl). The gradient of the coefficient is the gradient of the colour times the basis function.
static inline void step_coefficient(
    uint k,
    int degree,
    real lr,
    global real *sh,
    global const real *grad_sh,
    adam_moments adam,
    const ulong capacity
) {
    vreal basis[SH_COUNT], factor = (vreal)0;
    sh_basis(vec3_load(grad_sh + 3 * capacity, capacity), degree, basis);
    lanes_pick(factor, basis, SH_COUNT, k);
    for (int c = 0; c < 3; ++c)
        adam_step(factor * lanes_load(grad_sh + c * capacity), lr, sh, adam, (3 * k + c) * capacity);
}

// A geometry step has four parts. Each part reads and writes different rows, so that few memory streams are open at the
// same time. PART_OWN holds the opacities and the fields of the shape, except the skew.
static inline uint2 part_rows(uint part) {
    switch (part) {
    case PART_MEAN:
        return (uint2)(ROW_MEAN, ROW_MEAN + 3);
    case PART_QUAT:
        return (uint2)(ROW_QUAT, ROW_QUAT + 4);
    case PART_SCALE:
        return (uint2)(ROW_LOG_SCALE, ROW_LOG_SCALE + 3);
#ifdef ROW_SKEW
    default:
        return (uint2)(ROW_OPACITY_LOGIT, ROW_SKEW);
#else
    default:
        return (uint2)(ROW_OPACITY_LOGIT, GEOM_ROWS);
#endif
    }
}

// Adds the gradients of the regularisers to g, which holds the gradients of the rows of a part.
// 3DGS-MCMC: opacity_scale * sum(|opacity|) + scale_scale * sum(scale). With two opacities, |opacity| is their mean.
// 3DSGS: bisect_scale * sum((one opacity - other opacity)^2).
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
        const vreal v_minus = R(0.5) * opacity_scale * sign(o_minus) - gap;
        v_o = R(0.5) * v_o + gap;
        g[ROW_OPACITY_MINUS_LOGIT - ROW_OPACITY_LOGIT] += v_minus * opacity_slope(o_minus);
#endif
        g[0] += v_o * opacity_slope(o);
    }
}

// Steps one part of the geometry. rates [3, GEOM_ROWS] holds the rate of each row and two bounds. The bounds are those of
// fields that are optimised in log space, and 0 for the others. The rate of the means is mean_lr.
static inline void step_part(
    uint part,
    global real *geom,
    global const real *grad_geom,
    adam_moments adam,
    constant real *rates,
    const ulong capacity,
    real mean_lr,
    real opacity_scale,
    real scale_scale,
    real bisect_scale
) {
    const uint2 rows = part_rows(part);
    vreal g[PART_ROWS];
    for (uint row = rows.x; row < rows.y; ++row) g[row - rows.x] = lanes_load(grad_geom + row * capacity);
    if (opacity_scale > 0 || scale_scale > 0 || bisect_scale > 0)
        regularise(part, g, geom, capacity, opacity_scale, scale_scale, bisect_scale);
    for (uint row = rows.x; row < rows.y; ++row) {
        const real lr = part == PART_MEAN ? mean_lr : rates[row];
        const real low = rates[GEOM_ROWS + row], high = rates[2 * GEOM_ROWS + row];
        if (high > 0) adam_step_bounded(g[row - rows.x], lr, low, high, geom, adam, row * capacity);
        else adam_step(g[row - rows.x], lr, geom, adam, row * capacity);
    }
}

#ifdef ROW_SKEW
// Writes the kernel's skew from the trainable skew, and from the rotation if the map depends on it.
static inline void write_skew(global real *geom, global const real *skew_s, const ulong capacity) {
    vec3 skew = skew_of(skew_s, capacity);
#if SKEW_ROTATES
    skew = mat3_apply_transposed(quat_rotation(quat_load(geom + ROW_QUAT * capacity, capacity)), skew);
#endif
    vec3_store(skew, geom + ROW_SKEW * capacity, capacity);
}

// Steps the trainable skew skew_s [SKEW_WIDTH, capacity] and writes the kernel's skew.
static inline void step_skew(
    global real *geom,
    global const real *grad_geom,
    global real *skew_s,
    adam_moments adam,
    const ulong capacity,
    real lr
) {
    vreal v_s[SKEW_WIDTH];
    skew_of_vjp(skew_s, vec3_load(grad_geom + ROW_SKEW * capacity, capacity), v_s, capacity);
    for (int row = 0; row < SKEW_WIDTH; ++row) adam_step(v_s[row], lr, skew_s, adam, row * capacity);
    write_skew(geom, skew_s, capacity);
}

#if SKEW_ROTATES
// For maps that depend on the rotation. Turns the gradient of the skew into the world's frame, in place. Adds the
// gradient through the rotation to the gradient of the quaternion. Runs before step_splats.
kernel void turn_skew_gradient(
    global const real *restrict geom,
    global real *restrict grad_geom,
    global const real *restrict skew_s,
    ulong capacity
) {
    const ulong i = get_global_id(0) * LANES;
    const unit_quat q = quat_load(geom + ROW_QUAT * capacity + i, capacity);
    const vec3 a = skew_of(skew_s + i, capacity);
    const vec3 v = vec3_load(grad_geom + ROW_SKEW * capacity + i, capacity);
    global real *v_quat = grad_geom + ROW_QUAT * capacity + i;
    vreal g[4];
    for (int c = 0; c < 4; ++c) g[c] = lanes_load(v_quat + c * capacity);
    quat_rotation_vjp(q, (mat3){scale3(v, a.x), scale3(v, a.y), scale3(v, a.z)}, lanes_mask(1), v_quat, capacity);
    for (int c = 0; c < 4; ++c) lanes_store(g[c] + lanes_load(v_quat + c * capacity), v_quat + c * capacity);
    vec3_store(mat3_apply(quat_rotation(q), v), grad_geom + ROW_SKEW * capacity + i, capacity);
}

// Writes the kernel's skew while the trainable skew is frozen.
kernel void map_skew(global real *restrict geom, global const real *restrict skew_s, ulong capacity) {
    const ulong i = get_global_id(0) * LANES;
    write_skew(geom + i, skew_s + i, capacity);
}
#endif
#endif

// Steps all parameters. The second index of a work-item says what it steps. The first `coefficients` are those of the colour.
// Then come `parts` of the geometry, from first_part on, and then the skew. With a map that depends on the rotation, the skew
// has a launch of its own after the geometry. lr is the rate of the colour's constant band, rest_lr the rate of the others.
// With LAZY, vectors of splats with a negative age do not step (lazy.cl). Their geometry and skew do, unless geometry_waits.
// Global size: (capacity / LANES, coefficients + parts, and one more for the skew).
kernel void step_splats(
    global real *restrict sh,
    global const real *restrict grad_sh,
    global real *restrict sh_m,
    global real *restrict sh_v,
    global real *restrict geom,
    global const real *restrict grad_geom,
    global real *restrict geom_m,
    global real *restrict geom_v,
#ifdef ROW_SKEW
    global real *restrict skew_s,
    global real *restrict skew_m,
    global real *restrict skew_v,
    real skew_lr,
    real skew_correct1,
    real skew_correct2,
#endif
#if LAZY
    global const int2 *restrict ages,
    uint geometry_waits,
#endif
    constant real *restrict rates,
    ulong capacity,
    uint coefficients,
    uint first_part,
    uint parts,
    int sh_degree,
    real lr,
    real rest_lr,
    real mean_lr,
    real correct1,
    real correct2,
    real opacity_scale,
    real scale_scale,
    real bisect_scale
) {
    const ulong i = get_global_id(0) * LANES;
    const uint k = get_global_id(1);
#if LAZY
    if ((k < coefficients || geometry_waits) && ages[get_global_id(0)].x < 0) return;
#endif
    if (k < coefficients) {
        const adam_moments adam = {sh_m + i, sh_v + i, correct1, correct2};
        step_coefficient(k, sh_degree, k == 0 ? lr : rest_lr, sh + i, grad_sh + i, adam, capacity);
    } else if (k < coefficients + parts) {
        const adam_moments adam = {geom_m + i, geom_v + i, correct1, correct2};
        step_part(
            first_part + k - coefficients, geom + i, grad_geom + i, adam, rates, capacity, mean_lr, opacity_scale,
            scale_scale, bisect_scale
        );
    } else {
#ifdef ROW_SKEW
        const adam_moments adam = {skew_m + i, skew_v + i, skew_correct1, skew_correct2};
        step_skew(geom + i, grad_geom + i, skew_s + i, adam, capacity, skew_lr);
#endif
    }
}
