// lazy.cl: which vectors of splats a lazy step is for, and the steps that the others sat out, done without another
// (clsplat/training/optim/lazy.py, clsplat/training/optim/waiting.py).

#define CULLED_KEY 0xFFFFFFFFu  // as in project.cl

// Whose steps are due: of each vector of splats ages [vectors], the steps that everything but the skew, and the skew, sat out;
// -1 for vectors that go on waiting. A vector is woken by a splat that is seen (depth_key [n]: cl/render/project.cl), by
// having waited as long as the tables go, or if `all`. last [2, vectors]: the counts of steps that it was last brought up to,
// set to those after the step that follows, of which base_steps and skew_steps are the counts before. `peeks`: last stays.
kernel void wake_vectors(
    global const uint *restrict depth_key,
    global uint *restrict last,
    global int2 *restrict ages,
    uint vectors,
    uint n_splats,
    uint base_steps,
    uint skew_steps,
    uint base_learns,
    uint skew_learns,
    uint all,
    uint peeks
) {
    const uint v = get_global_id(0), first = v * LANES;
    if (v >= vectors) return;
    ages[v] = (int2)(-1, -1);
    if (first >= n_splats) return;
    const int2 age = {(int)(base_steps - last[v]), (int)(skew_steps - last[vectors + v])};
    uint woken = all || max(age.x, age.y) >= ADAM_WAITS - 1;
    if (!woken) {
        uint key = CULLED_KEY;  // which has all bits
        for (uint l = 0; l < LANES; ++l) key &= depth_key[min(first + l, n_splats - 1)];
        woken = key != CULLED_KEY;
    }
    if (!woken) return;
    ages[v] = age;
    if (peeks) return;
    last[v] = base_steps + base_learns;
    last[vectors + v] = skew_steps + skew_learns;
}

// The steps of step_splats that splats sat out, for those that wake_vectors woke; then nothing of geometry or colour is
// pending. keeps_moments: of the values only. Global size: (capacity / LANES, PARTS + coefficients).
kernel void settle_splats(
    global real *restrict geom,
    global real *restrict geom_m,
    global real *restrict geom_v,
    global real *restrict sh,
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
    real sh_lr,
    real sh_rest_lr,
    real skew_lr,
    uint keeps_moments
) {
    const ulong i = get_global_id(0) * LANES;
    const uint part = get_global_id(1);
    const int2 age = ages[get_global_id(0)];
    if (part < lazy_from || age.x < 0) return;
    if (part >= PARTS) {
        const adam_moments adam = {sh_m + i, sh_v + i, 0, 0};
        const uint k = part - PARTS;
        const adam_wait wait = waited_steps(waits, age.x, DRIFT, keeps_moments);
        if (age.x > 0) catch_up_coefficient(k, wait, k == 0 ? sh_lr : sh_rest_lr, sh + i, adam, capacity);
        return;
    }
    geom += i;
    const adam_moments adam = {geom_m + i, geom_v + i, 0, 0};
    if (age.x > 0) catch_up_rows(part_rows(part), waits, age.x, keeps_moments, geom, adam, rates, capacity);
#ifdef ROW_SKEW
    if (part != PART_MAPS) return;
    const adam_moments adam_s = {skew_m + i, skew_v + i, 0, 0};
    if (age.y > 0) catch_up_skew(waits, age.y, keeps_moments, skew_lr, skew_s + i, adam_s, capacity);
    if (age.y > 0 || SKEW_ROTATES) map_skew(geom, skew_s + i, capacity);
#endif
}
