// smoke.cl: a test of a device: y = exp(-x^2) + erfc(x) with one work-item per value.

kernel void smoke(
    global const float *restrict x,  // [n]
    global float *restrict y,        // [n], overwritten
    int n
) {
    int i = get_global_id(0);
    if (i < n) y[i] = exp(-x[i] * x[i]) + erfc(x[i]);
}
