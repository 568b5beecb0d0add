// depth.cl: smooth depths (clsplat/training/depth_smoothness.py). A depth is drawn as a colour: each splat has that of its
// centre in all three channels. SH_C0 is the constant harmonic (clsplat/splats/harmonics.py). Images are planar with a zero
// margin (rasterize.cl).

// Relative steps of the depth from one pixel of the photo to the next. Below the first one the penalty grows quadratically,
// above it linearly. Far above the second one it hardly grows in views without a photo: there one thing ends in front of
// another. In a photo its edges say so.
#define STEEPEST R(0.01)
#define BREAK R(0.05)
#define MOST_LIGHT R(0.2)  // pixels that let more light through have no depth
#define BYTE R(255.0)

// Writes sh [3, capacity], the constant harmonic with which a splat has the colour axis . mean + offset, its depth. Global
// size: at least n.
kernel void color_by_depth(
    global const real *restrict geom,
    global real *restrict sh,
    ulong capacity,
    uint n,
    real axis_x,
    real axis_y,
    real axis_z,
    real offset
) {
    const uint i = get_global_id(0);
    if (i >= n) return;
    global const real *mean = geom + ROW_MEAN * capacity + i;
    const real depth = axis_x * mean[0] + axis_y * mean[capacity] + axis_z * mean[2 * capacity] + offset;
    for (uint c = 0; c < 3; ++c) sh[c * capacity + i] = (depth - R(0.5)) / SH_C0;
}

static inline ulong pixel_at(int x, int y, int stride) { return (ulong)(y + MARGIN_Y) * stride + MARGIN_X + x; }

// How much a pixel of the photo differs from another one: the mean over the colours, 0 to 1.
static inline real difference(global const uchar *restrict truth, ulong at, ulong other, ulong plane) {
    real sum = 0;
    for (uint c = 0; c < 3; ++c) sum += fabs((real)truth[c * plane + at] - (real)truth[c * plane + other]);
    return sum / (3 * BYTE);
}

// Overwrites v_color [3 planes] with the gradient of weight * sum of exp(-edge * difference) * h((d - e) / (r m)). The sum
// is over all pairs of neighbours with depths d and e, and m is their mean, which counts as a constant. h has the slope
// x / STEEPEST, between -1 and 1, without a photo divided by 1 + (x / BREAK)^2. r is `reduction`: the photo is r times as
// wide and as high as the depths, and the pixel that belongs to a depth is the first one of r x r. photo_stride,
// photo_plane: of the photo. edge: 0 for views without a photo. Global size: (at least width, height).
kernel void smooth_depth(
    global const real *restrict color,
    global const real *restrict transmittance,
    global const uchar *restrict truth,
    global real *restrict v_color,
    int width,
    int height,
    int stride,
    ulong plane,
    int photo_stride,
    ulong photo_plane,
    int reduction,
    real weight,
    real edge
) {
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const ulong at = pixel_at(x, y, stride), in_photo = pixel_at(x * reduction, y * reduction, photo_stride);
    real sum = 0;
    for (int side = 0; side < 4; ++side) {
        const int dx = side < 2 ? 2 * side - 1 : 0, dy = side < 2 ? 0 : 2 * side - 5;
        const int u = x + dx, v = y + dy;
        if (u < 0 || v < 0 || u >= width || v >= height) continue;
        const ulong other = pixel_at(u, v, stride);
        if (transmittance[at] >= MOST_LIGHT || transmittance[other] >= MOST_LIGHT) continue;
        const real scale = reduction * max(R(0.5) * (color[at] + color[other]), R(1e-12));
        const real step = (color[at] - color[other]) / scale, far = step / BREAK;
        const real slope = lanes_clamp(step / STEEPEST, R(-1.0), R(1.0));
        const ulong beside = pixel_at(u * reduction, v * reduction, photo_stride);
        const real flat =
            edge > 0 ? exp(-edge * difference(truth, in_photo, beside, photo_plane)) : 1 / (1 + far * far);
        sum += flat * slope / scale;
    }
    v_color[at] = weight * sum;
    v_color[plane + at] = v_color[2 * plane + at] = 0;
}

// Adds to grad_geom [rows, capacity] the gradient of splats whose colour is their depth: other_geom [rows, capacity], and
// what the gradient of their colours, the first 3 rows of other_sh, means for their positions. Global size: at least n.
kernel void add_depth_gradient(
    global real *restrict grad_geom,
    global const real *restrict other_geom,
    global const real *restrict other_sh,
    ulong capacity,
    uint n,
    real axis_x,
    real axis_y,
    real axis_z
) {
    const uint i = get_global_id(0);
    if (i >= n) return;
    const real axis[3] = {axis_x, axis_y, axis_z};
    const real v_depth = other_sh[i] + other_sh[capacity + i] + other_sh[2 * capacity + i];
    for (uint row = 0; row < GEOM_ROWS; ++row) grad_geom[row * capacity + i] += other_geom[row * capacity + i];
    for (uint c = 0; c < 3; ++c) grad_geom[(ROW_MEAN + c) * capacity + i] += axis[c] * v_depth;
}
