// lazy.cl: Adam for visible splats (clsplat/training/optim/lazy.py has the formula). A vector of splats skips its steps
// while none of its splats is visible. Before its next step, the skipped steps are done in closed form.

// Effect of a number of skipped steps: factors of both moments, and the drift of the value per unit of rate and of
// m / sqrt(v). With `keeps_moments`, only the value changes.
typedef struct {
    real decay1, decay2, drift;
    bool keeps_moments;
} adam_skip;

// Returns the effect of `steps` skipped steps. decays is [5, ADAM_WAITS]: its rows hold the factors of m and v, and
// three drifts. DRIFT is the drift of most rows, DRIFT_MEAN that of the means (with the rate), DRIFT_SKEW that of the
// skew.
static inline adam_skip skipped_steps(constant real *decays, int steps, int drift, bool keeps_moments) {
    return (adam_skip){decays[steps], decays[ADAM_WAITS + steps], decays[drift * ADAM_WAITS + steps], keeps_moments};
}

// Does the skipped steps of a row. `high` > 0 marks fields that are optimised in log space. Their drift is monotonic,
// so one clamp at the end equals a clamp at every step.
static inline void
adam_catch_up(adam_skip skip, real lr, real low, real high, global real *value, adam_moments adam, const ulong at) {
    const vreal m = lanes_load(adam.m + at), v = lanes_load(adam.v + at), old = lanes_load(value + at);
    const vreal moved = lr * skip.drift * (m / (sqrt(v) + (vreal)ADAM_EPS));
    lanes_store(high > 0 ? lanes_clamp(old * exp(-moved), low, high) : old - moved, value + at);
    if (skip.keeps_moments) return;
    lanes_store(m * skip.decay1, adam.m + at);
    lanes_store(v * skip.decay2, adam.v + at);
}

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
    global real *restrict sh_m,
    global real *restrict sh_v,
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
    if (age.x <= 0) return;
    const adam_moments adam = {sh_m + i, sh_v + i, 0, 0};
    const adam_skip skip = skipped_steps(decays, age.x, DRIFT, keeps_moments);
    for (int c = 0; c < 3; ++c) adam_catch_up(skip, k == 0 ? lr : rest_lr, 0, 0, sh + i, adam, (3 * k + c) * capacity);
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
    if (age.x <= 0) return;
    const uint2 rows = part_rows(get_global_id(1));
    const bool means = rows.x == ROW_MEAN;
    const adam_moments adam = {geom_m + i, geom_v + i, 0, 0};
    const adam_skip skip = skipped_steps(decays, age.x, means ? DRIFT_MEAN : DRIFT, keeps_moments);
    for (uint row = rows.x; row < rows.y; ++row)
        adam_catch_up(
            skip, means ? (real)1 : rates[row], rates[GEOM_ROWS + row], rates[2 * GEOM_ROWS + row], geom + i, adam,
            row * capacity
        );
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
    const adam_moments adam = {skew_m + i, skew_v + i, 0, 0};
    const adam_skip skip = skipped_steps(decays, age.y, DRIFT_SKEW, keeps_moments);
    if (age.y > 0)
        for (int row = 0; row < SKEW_WIDTH; ++row) adam_catch_up(skip, lr, 0, 0, skew_s + i, adam, row * capacity);
    if (age.y > 0 || SKEW_ROTATES) write_skew(geom + i, skew_s + i, capacity);
}
#endif
