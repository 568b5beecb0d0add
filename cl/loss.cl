// loss.cl: (1 - lambda) L1 + lambda (1 - SSIM), its value and gradient with respect to the rendered image.
//
// SSIM: 11 x 11 Gaussian window, sigma 1.5, C1 = 0.01^2, C2 = 0.03^2, zero padding, mean over pixels and channels
// (Wang et al. 2004, as 3DGS uses it). The window is separable: two passes there, two back. Images are planar with
// a zero margin (see raster.cl), so no pass tests for a border. Global size: (runs in a row, rows, 3 channels);
// a run is LANES pixels.

#define SSIM_C1 R(0.0001)
#define SSIM_C2 R(0.0009)

constant real WINDOW[11] = {WINDOW_0, WINDOW_1, WINDOW_2, WINDOW_3, WINDOW_4, WINDOW_5,
                            WINDOW_4, WINDOW_3, WINDOW_2, WINDOW_1, WINDOW_0};

static inline ulong pixel_at(int stride, ulong plane) {
    return get_global_id(2) * plane + (get_global_id(1) + MARGIN_Y) * stride + get_global_id(0) * LANES + MARGIN_X;
}

// 8-bit interleaved RGB rows of `width` pixels into a planar image in [0, 1]. Overwrites width x height pixels.
kernel void unpack_image(
    global const uchar *restrict bytes,
    global real *restrict image,
    int width,
    int stride,
    ulong plane)
{
    const size_t x = get_global_id(0), y = get_global_id(1);
    for (int c = 0; c < 3; ++c)
        image[c * plane + (y + MARGIN_Y) * stride + x + MARGIN_X] =
            (real)bytes[3 * (y * width + x) + c] * (real)(1.0 / 255.0);
}

// maps [5, 3 planes]: x, y, xx, yy, xy blurred along rows; x rendered, y truth.
kernel void ssim_rows(
    global const real *restrict rendered,
    global const real *restrict truth,
    global real *restrict maps,
    int stride,
    ulong plane)
{
    const ulong at = pixel_at(stride, plane);
    vreal sx = (vreal)0, sy = (vreal)0, sxx = (vreal)0, syy = (vreal)0, sxy = (vreal)0;
    for (int k = 0; k < 11; ++k) {
        const vreal x = lanes_load(rendered + at + k - 5), y = lanes_load(truth + at + k - 5);
        const vreal wx = WINDOW[k] * x, wy = WINDOW[k] * y;
        sx += wx;
        sy += wy;
        sxx = lanes_mad(wx, x, sxx);
        syy = lanes_mad(wy, y, syy);
        sxy = lanes_mad(wx, y, sxy);
    }
    lanes_store(sx, maps + at);
    lanes_store(sy, maps + at + 3 * plane);
    lanes_store(sxx, maps + at + 6 * plane);
    lanes_store(syy, maps + at + 9 * plane);
    lanes_store(sxy, maps + at + 12 * plane);
}

// partial [3, n_runs]: sums of |x - y|, SSIM and (x - y)^2 over each run. v_maps [3, 3 planes]: gradient of SSIM with
// respect to the blurred x, xx and xy (zero outside the image). Overwrites.
kernel void ssim_columns(
    global const real *restrict rendered,
    global const real *restrict truth,
    global const real *restrict maps,
    global real *restrict v_maps,
    global real *restrict partial,
    int width,
    int stride,
    ulong plane)
{
    const ulong at = pixel_at(stride, plane);
    vreal mx = (vreal)0, my = (vreal)0, mxx = (vreal)0, myy = (vreal)0, mxy = (vreal)0;
    for (int k = 0; k < 11; ++k) {
        global const real *from = maps + at + (k - 5) * (long)stride;
        mx = lanes_mad(WINDOW[k], lanes_load(from), mx);
        my = lanes_mad(WINDOW[k], lanes_load(from + 3 * plane), my);
        mxx = lanes_mad(WINDOW[k], lanes_load(from + 6 * plane), mxx);
        myy = lanes_mad(WINDOW[k], lanes_load(from + 9 * plane), myy);
        mxy = lanes_mad(WINDOW[k], lanes_load(from + 12 * plane), mxy);
    }
    const vreal a1 = (real)2 * mx * my + SSIM_C1, a2 = (real)2 * (mxy - mx * my) + SSIM_C2;
    const vreal b1 = mx * mx + my * my + SSIM_C1, b2 = mxx - mx * mx + myy - my * my + SSIM_C2;
    const vreal inv = (vreal)1 / (b1 * b2);
    const vreal ssim = a1 * a2 * inv;
    const vreal v_mxy = (real)2 * a1 * inv, v_mxx = -ssim / b2;
    const vreal v_mx = (real)2 * my * (a2 - a1) * inv - (real)2 * mx * ssim * ((vreal)1 / b1 - (vreal)1 / b2);

    const vreal zero = (vreal)0;
    const vmask inside = (vreal)(get_global_id(0) * LANES) + lanes_iota() < (vreal)width;
    lanes_store(lanes_if(inside, v_mx, zero), v_maps + at);
    lanes_store(lanes_if(inside, v_mxx, zero), v_maps + at + 3 * plane);
    lanes_store(lanes_if(inside, v_mxy, zero), v_maps + at + 6 * plane);
    const vreal error = lanes_load(rendered + at) - lanes_load(truth + at);
    const ulong n_runs = get_global_size(0) * get_global_size(1) * get_global_size(2);
    const ulong run = (get_global_id(2) * get_global_size(1) + get_global_id(1)) * get_global_size(0) + get_global_id(0);
    partial[run] = lanes_sum(lanes_if(inside, fabs(error), zero));
    partial[n_runs + run] = lanes_sum(lanes_if(inside, ssim, zero));
    partial[2 * n_runs + run] = lanes_sum(lanes_if(inside, error * error, zero));
}

// hmaps [3, 3 planes]: v_maps blurred along rows (the window is symmetric: its own adjoint).
kernel void ssim_rows_vjp(
    global const real *restrict v_maps,
    global real *restrict hmaps,
    int stride,
    ulong plane)
{
    const ulong at = pixel_at(stride, plane);
    for (int map = 0; map < 3; ++map) {
        vreal sum = (vreal)0;
        for (int k = 0; k < 11; ++k) sum += WINDOW[k] * lanes_load(v_maps + at + 3 * map * plane + k - 5);
        lanes_store(sum, hmaps + at + 3 * map * plane);
    }
}

// v_color: gradient of the loss; l1_scale = (1 - lambda) / count, ssim_scale = lambda / count. Overwrites.
kernel void loss_vjp(
    global const real *restrict rendered,
    global const real *restrict truth,
    global const real *restrict hmaps,
    global real *restrict v_color,
    int width,
    int stride,
    ulong plane,
    real l1_scale,
    real ssim_scale)
{
    const ulong at = pixel_at(stride, plane);
    vreal v_mx = (vreal)0, v_mxx = (vreal)0, v_mxy = (vreal)0;
    for (int k = 0; k < 11; ++k) {
        global const real *from = hmaps + at + (k - 5) * (long)stride;
        v_mx = lanes_mad(WINDOW[k], lanes_load(from), v_mx);
        v_mxx = lanes_mad(WINDOW[k], lanes_load(from + 3 * plane), v_mxx);
        v_mxy = lanes_mad(WINDOW[k], lanes_load(from + 6 * plane), v_mxy);
    }
    const vreal x = lanes_load(rendered + at), y = lanes_load(truth + at), zero = (vreal)0;
    const vreal v_ssim = v_mx + (real)2 * x * v_mxx + y * v_mxy;
    const vreal sign_l1 = lanes_if(x > y, (vreal)1, lanes_if(x < y, (vreal)-1, zero));
    const vmask inside = (vreal)(get_global_id(0) * LANES) + lanes_iota() < (vreal)width;
    lanes_store(lanes_if(inside, l1_scale * sign_l1 - ssim_scale * v_ssim, zero), v_color + at);
}

// sums [3, n_parts]: runs of `run` values of partial [3, n], in order. Global size: (n_parts, 3).
kernel void sum_runs(
    global const real *restrict partial,
    global real *restrict sums,
    uint n,
    uint run)
{
    const ulong row = get_global_id(1);
    const ulong start = get_global_id(0) * run;
    real sum = 0;
    for (ulong k = start; k < start + run && k < n; ++k) sum += partial[row * n + k];
    sums[row * get_global_size(0) + get_global_id(0)] = sum;
}
