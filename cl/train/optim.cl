// optim.cl: one Adam step of colour, geometry and skew (steps.clh).
// The NumPy form is clsplat/training/optim/reference.py; a test compares both after each step.
// The first n_live splats step. Moments and the trainable skew have live_capacity columns.

#ifdef ROW_SKEW
#if SKEW_ROTATES
// For maps that depend on the rotation. Turns the gradient of the skew into the world's frame, in place. Adds the
// gradient through the rotation to the gradient of the quaternion. Runs before step_splats.
kernel void turn_skew_gradient(
    global const real *restrict geom,
    global real *restrict grad_geom,
    global const real *restrict skew_s,
    ulong capacity,
    ulong live_capacity
) {
    const ulong i = get_global_id(0) * LANES;
    const unit_quat q = quat_load(geom + ROW_QUAT * capacity + i, capacity);
    const vec3 a = skew_of(skew_s + i, live_capacity);
    const vec3 v = vec3_load(grad_geom + ROW_SKEW * capacity + i, capacity);
    global real *v_quat = grad_geom + ROW_QUAT * capacity + i;
    vreal g[4];
    for (int c = 0; c < 4; ++c) g[c] = lanes_load(v_quat + c * capacity);
    quat_rotation_vjp(q, (mat3){scale3(v, a.x), scale3(v, a.y), scale3(v, a.z)}, lanes_mask(1), v_quat, capacity);
    for (int c = 0; c < 4; ++c) lanes_store(g[c] + lanes_load(v_quat + c * capacity), v_quat + c * capacity);
    vec3_store(mat3_apply(quat_rotation(q), v), grad_geom + ROW_SKEW * capacity + i, capacity);
}

// Writes the kernel's skew while the trainable skew is frozen.
kernel void map_skew(
    global real *restrict geom,
    global const real *restrict skew_s,
    ulong capacity,
    ulong live_capacity,
    uint n_live
) {
    const ulong i = get_global_id(0) * LANES;
    write_skew(geom + i, skew_s + i, capacity, live_capacity, live_lanes(i, n_live));
}
#endif
#endif

// Steps all parameters. The second index of a work-item says what it steps. The first are the `coefficients` of the colour:
// COEFFICIENTS of them each. CPUs take one, so that few memory streams are open at the same time. GPUs take all, so that the
// gradient is read once, and many loads are under way. Then come `parts` of the geometry, from first_part on, and then the
// skew. With a map that depends on the rotation, the skew has a launch of its own after the geometry. lr is the rate of the
// colour's constant band, rest_lr the rate of the others.
// With LAZY, vectors of splats with a negative age do not step (lazy.clh). Their geometry and skew do, unless geometry_waits.
// With `catches_up`, the others do their skipped steps first.
// Global size: (capacity / LANES, coefficients / COEFFICIENTS, rounded up, + parts, and one more for the skew).
kernel void step_splats(
    global real *restrict sh,
    global const real *restrict grad_sh,
#if HALF_MOMENTS
    global real *restrict sh_moments,
    uint seed_lo,
    uint seed_hi,
    uint step,
#endif
#if FULL_MOMENTS
    global real *restrict sh_m,
    global real *restrict sh_v,
#endif
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
    constant real *restrict decays,
    uint geometry_waits,
    uint catches_up,
#endif
    constant real *restrict rates,
    ulong capacity,
    ulong live_capacity,
    uint n_live,
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
    const vmask live = live_lanes(i, n_live);
#if LAZY
    const int2 age = ages[get_global_id(0)];
    if ((k * COEFFICIENTS < coefficients || geometry_waits) && age.x < 0) return;
    const int2 skipped = catches_up ? age : (int2)(0, 0);
#endif
    const uint color_items = (coefficients + COEFFICIENTS - 1) / COEFFICIENTS;
    if (k < color_items) {
#if HALF_MOMENTS
        const color_moments adam = {
            sh_moments + i, live_capacity, live, correct1, correct2, (uint2)(seed_lo, seed_hi), step, i
        };
#else
        const color_moments adam = {sh_m + i, sh_v + i, live_capacity, live, correct1, correct2};
#endif
        UNROLL for (uint j = 0; j < COEFFICIENTS; ++j) {
            const uint c = COEFFICIENTS == SH_COUNT ? j : k * COEFFICIENTS + j;
            if (c < coefficients) {
                const real rate = c == 0 ? lr : rest_lr;
#if LAZY
                catch_up_coefficient(c, skipped.x, decays, rate, sh + i, adam, capacity, false);
#endif
                step_coefficient(c, sh_degree, rate, sh + i, grad_sh + i, adam, capacity);
            }
        }
    } else if (k < color_items + parts) {
        const adam_moments adam = {geom_m + i, geom_v + i, live_capacity, live, correct1, correct2};
#if LAZY
        if (geometry_waits)
            catch_up_part(first_part + k - color_items, skipped.x, decays, rates, geom + i, adam, capacity, false);
#endif
        step_part(
            first_part + k - color_items, geom + i, grad_geom + i, adam, rates, capacity, mean_lr, opacity_scale,
            scale_scale, bisect_scale
        );
    } else {
#ifdef ROW_SKEW
        const adam_moments adam = {skew_m + i, skew_v + i, live_capacity, live, skew_correct1, skew_correct2};
#if LAZY
        if (geometry_waits) catch_up_skew(skipped.y, decays, skew_lr, skew_s + i, adam, capacity, false);
#endif
        step_skew(geom + i, grad_geom + i, skew_s + i, adam, capacity, skew_lr);
#endif
    }
}
