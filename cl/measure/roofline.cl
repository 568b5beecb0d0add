// limits.cl: what a device can do at best: bytes copied, and fused multiply-adds on CHAINS independent vectors.

// n vectors of LANES. Global size: n.
kernel void copy_vectors(global const real *restrict values, global real *restrict copied, ulong n) {
    const ulong i = get_global_id(0);
    if (i < n) lanes_store(lanes_load(values + i * LANES), copied + i * LANES);
}

// sums [items]: x -> a x + b, `rounds` times 16 steps on each chain, which starts at its number plus the lane's; then all
// are added up. 2 * 16 * CHAINS * LANES flops a round.
kernel void fma_chains(global real *restrict sums, real a, real b, uint rounds) {
    vreal x[CHAINS];
    for (int c = 0; c < CHAINS; ++c) x[c] = (vreal)c + lanes_iota();
    for (uint round = 0; round < rounds; ++round) {
#pragma unroll
        for (int step = 0; step < 16; ++step)
#pragma unroll
            for (int c = 0; c < CHAINS; ++c) x[c] = fma(x[c], (vreal)a, (vreal)b);
    }
    vreal sum = (vreal)0;
    for (int c = 0; c < CHAINS; ++c) sum += x[c];
    sums[get_global_id(0)] = lanes_sum(sum);
}
