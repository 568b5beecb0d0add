// roofline.cl: kernels that measure the peak rates of a device: a copy, and fused multiply-adds on CHAINS vectors.

// Copies n values of type COPIED. On GPUs it has four reals: with one, too few bytes of a work-item are under way.
// Global size: n.
kernel void copy_vectors(global const COPIED *restrict values, global COPIED *restrict copied, ulong n) {
    const ulong i = get_global_id(0);
    if (i < n) copied[i] = values[i];
}

// Overwrites sums [items] with the sum of all chains of a work-item. A chain starts at its number plus the number of
// the lane. It then makes 16 * rounds steps x -> a x + b. A round has 2 * 16 * CHAINS * LANES flops.
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
