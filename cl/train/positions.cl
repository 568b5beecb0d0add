// positions.cl: steps of the means besides Adam: SGHMC, and the exploration noise of 3DGS-MCMC.
// The NumPy forms are clsplat/training/optim/sghmc.py and tests/reference/noise.py.

// Does one SGHMC step of the means. momentum is [3, capacity]; sghmc.py has the formula and the coefficients.
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
        const ulong row = (ROW_MEAN + c) * capacity + first, momentum_row = c * capacity + first;
        const vreal g = adam_direction(lanes_load(grad_geom + row), adam_m + row, adam_v + row, correct1, correct2);
        const vreal p = gate * (keep * lanes_load(momentum + momentum_row) + noise * random[c]) - drive * g;
        lanes_store(p, momentum + momentum_row);
        lanes_store(lanes_load(geom + row) + length * p, geom + row);
    }
}

// Adds noise to the means: mean += Sigma (xi gate amount), with Sigma = R S S R' and gate = sigmoid(0.5 - 100 opacity)
// (3DGS-MCMC, Kheradmand et al. 2024). The length of the step is at most `reach`. A longer step could move a large
// splat out of the scene, and it would not come back.
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
