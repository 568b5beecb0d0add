// exposure.cl: exposure, masks and transparent pixels of photos.
//
// The exposure E of a photo is 12 reals, three rows with three factors and an offset: photo = E (r, g, b, 1), where r,
// g and b are colours of the render. A pixel that a mask hides has neither an error nor a gradient. A transparent pixel
// of a photo is composited over the background of the render, which has no exposure. The truth has planes of bytes: r,
// g, b, and with 5 channels also the mask (0 hides) and the opacity. A work-item computes PHOTO_VECS vectors of a row.
// Images are planar with a zero margin (rasterize.cl).

#define EXPOSURE 12
#define SQUARES 10  // entries of the upper triangle of a 4 x 4 matrix, by rows
// clsplat/training/programs.py defines SUMS, and uses it for the size of the buffer of the sums.
typedef char there_are_SUMS_sums[SUMS == SQUARES + EXPOSURE ? 1 : -1];
#define SATURATED R(0.98)  // pixels of a photo that are brighter than this do not count for the exposure

// The number of vectors of a row. A work-item computes those from `first` up to, but not including, `end`.
typedef struct {
    int vecs, first, end;
} row_part;

static inline row_part item_part(int width) {
    const int vecs = (width + LANES - 1) / LANES, first = get_global_id(0) * PHOTO_VECS;
    return (row_part){vecs, first, min(first + PHOTO_VECS, vecs)};
}

// Mask of the pixels of a vector that are inside the image and not hidden.
static inline vmask counted(global const uchar *truth, ulong plane, int channels, int vec, int width) {
    const vmask inside = lanes_before(vec * LANES, width);
    return channels > 3 ? inside & (lanes_uchar_to_real(truth + 3 * plane) > (vreal)0) : inside;
}

// The part of the background in the pixels of a photo, 0 to 1.
static inline vreal transparency(global const uchar *truth, ulong plane, int channels) {
    return channels > 3 ? (vreal)1 - lanes_uchar_to_real(truth + 4 * plane) * BYTE_STEP : (vreal)0;
}

// Overwrites photo [3 planes] with the render under the exposure of the photo. With 5 channels it also overwrites
// target [3 planes of bytes] with the truth over the background of the render. back: that background. shift: it minus
// the background of the truth, times 255.
// Global size: (at least the vectors of a row / PHOTO_VECS, height).
kernel void photo_of_render(
    global const real *restrict color,
    global const uchar *restrict truth,
    global const real *restrict exposures,
    global real *restrict photo,
    global uchar *restrict target,
    int view,
    int channels,
    int width,
    int height,
    int stride,
    ulong plane,
    real back_r,
    real back_g,
    real back_b,
    real shift_r,
    real shift_g,
    real shift_b
) {
    const row_part item = item_part(width);
    const int y = get_global_id(1);
    global const real *row = exposures + EXPOSURE * view;
    const real back[3] = {back_r, back_g, back_b}, shift[3] = {shift_r, shift_g, shift_b};
    const vreal zero = (vreal)0;
    real behind[3];  // what the exposure would change of the background, with the other sign
    for (int c = 0; c < 3; ++c) {
        global const real *e = row + 4 * c;
        behind[c] = back[c] - (e[0] * back_r + e[1] * back_g + e[2] * back_b + e[3]);
    }
    if (y >= height) return;
    for (int vec = item.first; vec < item.end; ++vec) {
        const ulong at = (ulong)(y + MARGIN_Y) * stride + MARGIN_X + vec * LANES;
        const vmask inside = lanes_before(vec * LANES, width),
                    counts = counted(truth + at, plane, channels, vec, width);
        const vreal r = lanes_load(color + at), g = lanes_load(color + at + plane),
                    b = lanes_load(color + at + 2 * plane);
        const vreal through = transparency(truth + at, plane, channels);
        for (int c = 0; c < 3; ++c) {
            global const real *e = row + 4 * c;
            vreal shown = lanes_mad(r, (vreal)e[0], lanes_mad(g, (vreal)e[1], lanes_mad(b, (vreal)e[2], (vreal)e[3])));
            shown = lanes_mad(through, (vreal)behind[c], shown);
            if (channels > 3) {
                vreal aim = lanes_mad(through, (vreal)shift[c], lanes_uchar_to_real(truth + at + c * plane));
                aim = lanes_if(inside, rint(lanes_clamp(aim, 0, 255)), zero);
                lanes_real_to_uchar(aim, target + at + c * plane);
                shown = lanes_if(counts, shown, aim * BYTE_STEP);
            }
            lanes_store(lanes_if(inside, shown, zero), photo + at + c * plane);
        }
    }
}

// Changes v [3 planes] from the gradient of the photo to the gradient of the render. Overwrites partial [SUMS, parts]
// with the sums of x x' and y x'. Here x is what the exposure multiplies and y is the target, without its background.
// The sums include the pixels that are neither hidden, transparent nor saturated. With 3 channels the target is the
// truth. Global size: that of photo_of_render.
kernel void photo_of_render_vjp(
    global const real *restrict color,
    global const uchar *restrict truth,
    global const uchar *restrict target,
    global const real *restrict exposures,
    global real *restrict v,
    global real *restrict partial,
    int view,
    int channels,
    int width,
    int height,
    int stride,
    ulong plane,
    real back_r,
    real back_g,
    real back_b
) {
    const row_part item = item_part(width);
    const int y = get_global_id(1);
    global const real *row = exposures + EXPOSURE * view;
    const real back[3] = {back_r, back_g, back_b};
    const vreal zero = (vreal)0;
    vreal sums[SUMS];
    for (int j = 0; j < SUMS; ++j) sums[j] = zero;
    if (y >= height || item.first >= item.vecs) return;
    for (int vec = item.first; vec < item.end; ++vec) {
        const ulong at = (ulong)(y + MARGIN_Y) * stride + MARGIN_X + vec * LANES;
        const vmask counts = counted(truth + at, plane, channels, vec, width);
        const vreal through = transparency(truth + at, plane, channels);
        vreal x[4], v_photo[3], aim[3], brightest = zero;
        for (int c = 0; c < 3; ++c) {
            x[c] = lanes_load(color + at + c * plane) - through * (vreal)back[c];
            aim[c] = lanes_uchar_to_real(target + at + c * plane) * BYTE_STEP;
            brightest = max(brightest, aim[c]);
            aim[c] -= through * (vreal)back[c];
            v_photo[c] = lanes_if(counts, lanes_load(v + at + c * plane), zero);
        }
        for (int c = 0; c < 3; ++c)
            lanes_store(
                lanes_mad(
                    v_photo[0], (vreal)row[c], lanes_mad(v_photo[1], (vreal)row[4 + c], v_photo[2] * (vreal)row[8 + c])
                ),
                v + at + c * plane
            );
        x[3] = (vreal)1 - through;
        const vmask fitted = counts & (through < (vreal)1) & (brightest < (vreal)SATURATED);
        for (int c = 0; c < 4; ++c) x[c] = lanes_if(fitted, x[c], zero);
        int j = 0;
        for (int a = 0; a < 4; ++a)
            for (int b = a; b < 4; ++b, ++j) sums[j] = lanes_mad(x[a], x[b], sums[j]);
        for (int c = 0; c < 3; ++c)
            for (int b = 0; b < 4; ++b, ++j) sums[j] = lanes_mad(aim[c], x[b], sums[j]);
    }
    const int items = (item.vecs + PHOTO_VECS - 1) / PHOTO_VECS;
    const ulong parts = (ulong)items * height, part = (ulong)y * items + get_global_id(0);
    for (int j = 0; j < SUMS; ++j) partial[j * parts + part] = lanes_sum(sums[j]);
}

// Computes the least-squares exposure: solves S E' = T' by Cholesky's method. S is the sum of x x' and T the sum of y
// x', each plus `pull` times the identity.
static inline void solve_exposure(local const real *sums, real pull, real *exposure) {
    real l[4][4];
    int j = 0;
    for (int a = 0; a < 4; ++a)
        for (int b = a; b < 4; ++b, ++j) l[b][a] = sums[j] + (a == b ? pull : 0);
    for (int a = 0; a < 4; ++a)
        for (int b = a; b < 4; ++b) {
            for (int k = 0; k < a; ++k) l[b][a] -= l[b][k] * l[a][k];
            l[b][a] = a == b ? sqrt(max(l[b][a], R(1e-20))) : l[b][a] / l[a][a];
        }
    for (int c = 0; c < 3; ++c) {
        real *e = exposure + 4 * c;
        for (int a = 0; a < 4; ++a) {
            e[a] = sums[SQUARES + 4 * c + a] + (a == c ? pull : 0);
            for (int k = 0; k < a; ++k) e[a] -= l[a][k] * e[k];
            e[a] /= l[a][a];
        }
        for (int a = 3; a >= 0; --a) {
            for (int k = a + 1; k < 4; ++k) e[a] -= l[k][a] * e[k];
            e[a] /= l[a][a];
        }
    }
}

// Moves the exposure of a view by the fraction `rate` towards the least-squares exposure. `pull`, a fraction of the
// pixels, draws the latter to the identity. Then all exposures are shifted so that the mean of `held` of them stays. The
// mean must be fixed, because a gain of all photos and its inverse in all splats give the same images. Views without a
// photo have the mean exposure. `held` is the number of views with a mean to keep, or 0 if the view is not one of them.
// exposures [views, EXPOSURE], in place. One group of EXPOSURE_GROUP work-items.
kernel void step_exposure(
    global real *restrict exposures,
    global const real *restrict partial,
    int parts,
    int view,
    int views,
    int held,
    real rate,
    real pull
) {
    local real shares[EXPOSURE_GROUP][SUMS], sums[SUMS], moved[EXPOSURE];
    const int item = get_local_id(0);
    for (int j = 0; j < SUMS; ++j) {
        real sum = 0;
        for (int part = item; part < parts; part += EXPOSURE_GROUP) sum += partial[(ulong)j * parts + part];
        shares[item][j] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int j = item; j < SUMS; j += EXPOSURE_GROUP) {
        real sum = 0;
        for (int other = 0; other < EXPOSURE_GROUP; ++other) sum += shares[other][j];
        sums[j] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        const real pixels = sums[SQUARES - 1];
        real best[EXPOSURE];
        solve_exposure(sums, max(pull * pixels, R(1e-6)), best);
        for (int j = 0; j < EXPOSURE; ++j)
            moved[j] = pixels > 0 ? rate * (best[j] - exposures[EXPOSURE * view + j]) : 0;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int at = item; at < EXPOSURE * views; at += EXPOSURE_GROUP) {
        const int j = at % EXPOSURE;
        exposures[at] += (at / EXPOSURE == view ? moved[j] : 0) - (held > 0 ? moved[j] / held : 0);
    }
}
