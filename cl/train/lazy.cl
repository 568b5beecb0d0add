// lazy.cl: which vectors of splats step, and skipped steps without a step (lazy.clh). All splats change: moments have the
// capacity of the splats.

// Selects the vectors that step now. A vector steps if one of its splats is visible (depth_key [n],
// cl/render/project.cl) or if it has the maximum age. ages gets the numbers of skipped steps of the base parameters and
// of the skew, or (-1, -1) if the vector does not step. last [2, vectors] holds the step counts that each vector has
// reached; those of selected vectors become the counts after the next step. base_steps and skew_steps are the counts
// before the next step.
kernel void wake_visible(
    global const uint *restrict depth_key,
    global uint *restrict last,
    global int2 *restrict ages,
    uint vectors,
    uint n_splats,
    uint base_steps,
    uint skew_steps,
    uint base_learns,
    uint skew_learns
) {
    const uint v = get_global_id(0), first = v * LANES;
    if (v >= vectors) return;
    ages[v] = (int2)(-1, -1);
    if (first >= n_splats) return;
    const int2 age = {(int)(base_steps - last[v]), (int)(skew_steps - last[vectors + v])};
    uint awake = max(age.x, age.y) >= ADAM_WAITS - 1;
    if (!awake) {
        uint key = CULLED_KEY;  // all bits are set, so `&` keeps it only if all splats are culled
        for (uint l = 0; l < LANES; ++l) key &= depth_key[min(first + l, n_splats - 1)];
        awake = key != CULLED_KEY;
    }
    if (!awake) return;
    ages[v] = age;
    last[v] = base_steps + base_learns;
    last[vectors + v] = skew_steps + skew_learns;
}

// Selects all vectors to do their skipped steps only. `last` does not change.
kernel void wake_all(
    global const uint *restrict last,
    global int2 *restrict ages,
    uint vectors,
    uint n_splats,
    uint base_steps,
    uint skew_steps
) {
    const uint v = get_global_id(0);
    if (v >= vectors) return;
    const int2 age = {(int)(base_steps - last[v]), (int)(skew_steps - last[vectors + v])};
    ages[v] = v * LANES < n_splats ? age : (int2)(-1, -1);
}

// The three settle kernels do the skipped steps of the selected vectors: of the colour, of the geometry except the
// skew, and of the skew. Global sizes: (capacity / LANES, coefficients of all bands), (capacity / LANES, parts), capacity / LANES.
kernel void settle_color(
    global real *restrict sh,
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
    global const int2 *restrict ages,
    constant real *restrict decays,
    ulong capacity,
    real lr,
    real rest_lr,
    uint keeps_moments
) {
    const ulong i = get_global_id(0) * LANES;
    const uint k = get_global_id(1);
    const int2 age = ages[get_global_id(0)];
#if HALF_MOMENTS
    const color_moments adam = {sh_moments + i, capacity, lanes_mask(1), 0, 0, (uint2)(seed_lo, seed_hi), step, i};
#else
    const color_moments adam = {sh_m + i, sh_v + i, capacity, lanes_mask(1), 0, 0};
#endif
    catch_up_coefficient(k, age.x, decays, k == 0 ? lr : rest_lr, sh + i, adam, capacity, keeps_moments);
}
kernel void settle_geometry(
    global real *restrict geom,
    global real *restrict geom_m,
    global real *restrict geom_v,
    global const int2 *restrict ages,
    constant real *restrict decays,
    constant real *restrict rates,
    ulong capacity,
    uint keeps_moments
) {
    const ulong i = get_global_id(0) * LANES;
    const int2 age = ages[get_global_id(0)];
    const adam_moments adam = {geom_m + i, geom_v + i, capacity, lanes_mask(1), 0, 0};
    catch_up_part(get_global_id(1), age.x, decays, rates, geom + i, adam, capacity, keeps_moments);
}
#ifdef ROW_SKEW
kernel void settle_skew(
    global real *restrict geom,
    global real *restrict skew_s,
    global real *restrict skew_m,
    global real *restrict skew_v,
    global const int2 *restrict ages,
    constant real *restrict decays,
    ulong capacity,
    real lr,
    uint keeps_moments
) {
    const ulong i = get_global_id(0) * LANES;
    const int2 age = ages[get_global_id(0)];
    if (age.x < 0) return;
    const adam_moments adam = {skew_m + i, skew_v + i, capacity, lanes_mask(1), 0, 0};
    catch_up_skew(age.y, decays, lr, skew_s + i, adam, capacity, keeps_moments);
    if (age.y > 0 || SKEW_ROTATES) write_skew(geom + i, skew_s + i, capacity, capacity, lanes_mask(1));
}
#endif
