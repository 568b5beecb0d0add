// roofline.cl: the peak rates of a device: bytes copied, and fused multiply-adds on CHAINS independent vectors.

// Copies n vectors of LANES reals. Global size: n.
kernel void copy_vectors(global const real *restrict values, global real *restrict copied, ulong n) {
    const ulong i = get_global_id(0);
    if (i < n) lanes_store(lanes_load(values + i * LANES), copied + i * LANES);
}

// Overwrites sums [items]. Each chain starts at its number plus that of the lane and makes `rounds` times 16 steps
// x -> a x + b; the results are added. A round has 2 * 16 * CHAINS * LANES flops.
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
