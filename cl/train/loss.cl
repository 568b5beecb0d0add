// loss.cl: (1 - lambda) smooth L1 + lambda (1 - SSIM), its value and gradient with respect to the rendered image.
//
// Smooth L1 of an error e is e^2 / (2 beta) below beta, and |e| - beta / 2 from there on. Kernels get beta and
// steepness = 1 / beta, or 0 and a huge number, which makes it L1.
//
// SSIM: 11 x 11 Gaussian window (constants: clsplat/evaluation/metrics.py), zero padding, mean over pixels and channels
// (Wang et al. 2004, with the constants of 3DGS). The formulas use the sum s = x + y and the difference d = x - y of
// the rendered image x and the truth y. m is the mean over the window and h half the variance, (E[s^2] - m_s^2) / 2:
//   2 m_x m_y = (m_s^2 - m_d^2) / 2    m_x^2 + m_y^2 = (m_s^2 + m_d^2) / 2
//   2 cov = h_s - h_d                  var_x + var_y = h_s + h_d
// So four maps are blurred instead of five, and fewer digits cancel if x is close to y.
//
// A work-item computes `segment` rows of a strip, from the top. A strip has up to STRIP vectors (one vector if LANES is
// 1). The work-item blurs each row, keeps the last 11 rows in a ring, and blurs the columns of the ring. So no blurred
// map is stored. Global size: (at least the strips, segments, 3 channels). Images are planar with a zero margin
// (rasterize.cl); the truth has bytes.

#define REACH 5
#define TAPS 11
#define SIDE ((REACH + LANES - 1) / LANES)  // vectors that the window reaches beyond a strip

// The ring is [RING][STRIP][maps]. Each row is written twice, 11 slots apart, so the last 11 rows are always
// contiguous. With one lane the rows move up instead. Then every index is a constant, and the ring fits into registers.
#define SHIFT (LANES == 1)
#define RING (SHIFT ? TAPS : 2 * TAPS)
#define SLOT (SHIFT ? TAPS - 1 : slot)
#define MID ((SHIFT ? 0 : slot) + REACH)  // slot of the row in the middle of the window
#define PUT(map, value) (ring[SLOT][v][map] = ring[SHIFT ? SLOT : SLOT + TAPS][v][map] = (value))
#define MOVE_UP(maps) \
    if (SHIFT) \
        for (int k = 0; k < TAPS - 1; ++k) \
            for (int map = 0; map < maps; ++map) ring[k][0][map] = ring[k + 1][0][map];

#define truth_load(p) (lanes_uchar_to_real(p) * BYTE_STEP)

// Expands to pair(weight, k) for each distance k of two pixels from the centre. Not every compiler unrolls a loop here.
#define PAIRS_OF_WINDOW(pair) pair(WINDOW_4, 1) pair(WINDOW_3, 2) pair(WINDOW_2, 3) pair(WINDOW_1, 4) pair(WINDOW_0, 5)

// The part of the image that a work-item computes.
typedef struct {
    int first, n;  // vectors of a row
    int top, end;  // rows
    ulong at;      // index of the strip's first pixel in row 0
} strip;

static inline int strips_of(int stride) { return ((stride - 2 * MARGIN_X) / LANES + STRIP - 1) / STRIP; }

// Returns the strip of this work-item. The widths of strips differ by one vector at most.
static inline strip item_strip(int height, int stride, ulong plane, int segment) {
    const int vecs = (stride - 2 * MARGIN_X) / LANES, strips = strips_of(stride), i = get_global_id(0);
    strip item;
    item.first = i * vecs / strips;
    item.n = STRIP == 1 ? 1 : (i + 1) * vecs / strips - item.first;
    item.top = get_global_id(1) * segment;
    item.end = min(item.top + segment, height);
    item.at = get_global_id(2) * plane + (ulong)MARGIN_Y * stride + item.first * LANES + MARGIN_X;
    return item;
}

// Overwrites planes of bytes with a zero margin, from 8-bit interleaved rows of `channels`.
// Global size: (stride, rows).
kernel void unpack_image(
    global const uchar *restrict bytes,
    global uchar *restrict truth,
    int channels,
    int width,
    int height,
    ulong plane
) {
    const int x = (int)get_global_id(0) - MARGIN_X, y = (int)get_global_id(1) - MARGIN_Y;
    const bool inside = x >= 0 && x < width && y >= 0 && y < height;
    const ulong at = get_global_id(1) * get_global_size(0) + get_global_id(0);
    for (int c = 0; c < channels; ++c)
        truth[c * plane + at] = inside ? bytes[channels * ((ulong)y * width + x) + c] : (uchar)0;
}

// Overwrites partial [4, channels, segments, strips] with the sums of smooth L1, SSIM, |x - y| and (x - y)^2. Overwrites v_maps
// [3, 3 planes] with the gradients of SSIM with respect to the window's mean of x, h_s and h_d, zero outside the image.
kernel void image_loss(
    global const real *restrict rendered,
    global const uchar *restrict truth,
    global real *restrict v_maps,
    global real *restrict partial,
    int width,
    int height,
    int stride,
    ulong plane,
    int segment,
    real beta,
    real steepness
) {
    const int strips = strips_of(stride);
    if (get_global_id(0) >= strips) return;
    const strip item = item_strip(height, stride, plane, segment);
    vreal ring[RING][STRIP][4];  // s, d, s^2, d^2
    real s_row[(STRIP + 2 * SIDE) * LANES], d_row[(STRIP + 2 * SIDE) * LANES];
    vreal smooth = (vreal)0, ssims = (vreal)0, l1 = (vreal)0, squares = (vreal)0;
    const vreal zero = (vreal)0;
    int slot = 0;
    for (int row = item.top - REACH; row < item.end + REACH; ++row) {
        MOVE_UP(4)
        if (row >= 0 && row < height) {
            const ulong at = item.at + (long)row * stride - SIDE * LANES;
            for (int v = 0; v < item.n + 2 * SIDE; ++v) {
                const vreal x = lanes_load(rendered + at + v * LANES), y = truth_load(truth + at + v * LANES);
                lanes_store(x + y, s_row + v * LANES);
                lanes_store(x - y, d_row + v * LANES);
            }
            for (int v = 0; v < item.n; ++v) {
                const real *s_at = s_row + (SIDE + v) * LANES, *d_at = d_row + (SIDE + v) * LANES;
                const vreal s = lanes_load(s_at), d = lanes_load(d_at);
                vreal s1 = WINDOW_5 * s, d1 = WINDOW_5 * d, s2 = s1 * s, d2 = d1 * d;
#define ADD_PAIR(w, k) \
    { \
        const vreal sa = lanes_load(s_at - k), sb = lanes_load(s_at + k); \
        const vreal da = lanes_load(d_at - k), db = lanes_load(d_at + k); \
        s1 = lanes_mad(w, sa + sb, s1); \
        d1 = lanes_mad(w, da + db, d1); \
        s2 = lanes_mad(w, lanes_mad(sa, sa, sb * sb), s2); \
        d2 = lanes_mad(w, lanes_mad(da, da, db * db), d2); \
    }
                PAIRS_OF_WINDOW(ADD_PAIR)
#undef ADD_PAIR
                PUT(0, s1);
                PUT(1, d1);
                PUT(2, s2);
                PUT(3, d2);
            }
        } else {
            for (int v = 0; v < item.n; ++v)
                for (int map = 0; map < 4; ++map) PUT(map, zero);
        }
        slot = SHIFT || slot == TAPS - 1 ? 0 : slot + 1;
        if (row < item.top + REACH) continue;
        const ulong centre = item.at + (long)(row - REACH) * stride;
        for (int v = 0; v < item.n; ++v) {
            vreal ms = WINDOW_5 * ring[MID][v][0], md = WINDOW_5 * ring[MID][v][1];
            vreal ms2 = WINDOW_5 * ring[MID][v][2], md2 = WINDOW_5 * ring[MID][v][3];
#define ADD_PAIR(w, k) \
    ms = lanes_mad(w, ring[MID - k][v][0] + ring[MID + k][v][0], ms); \
    md = lanes_mad(w, ring[MID - k][v][1] + ring[MID + k][v][1], md); \
    ms2 = lanes_mad(w, ring[MID - k][v][2] + ring[MID + k][v][2], ms2); \
    md2 = lanes_mad(w, ring[MID - k][v][3] + ring[MID + k][v][3], md2);
            PAIRS_OF_WINDOW(ADD_PAIR)
#undef ADD_PAIR
            const vreal half_s = R(0.5) * ms * ms, half_d = R(0.5) * md * md;
            const vreal hs = lanes_mad(R(0.5), ms2, -half_s), hd = lanes_mad(R(0.5), md2, -half_d);
            const vreal a1 = half_s - half_d + SSIM_C1, b1 = half_s + half_d + SSIM_C1;
            const vreal a2 = hs - hd + SSIM_C2, b2 = hs + hd + SSIM_C2;
            const vreal inv = (vreal)1 / (b1 * b2), ssim = a1 * a2 * inv;
            const vreal by_a1 = a2 * inv, by_a2 = a1 * inv, by_b1 = -ssim * inv * b2, by_b2 = -ssim * inv * b1;
            const vreal v_hs = by_b2 + by_a2, v_hd = by_b2 - by_a2;
            const vreal v_mean = lanes_mad(ms, by_b1 + by_a1 - v_hs, md * (by_b1 - by_a1 - v_hd));

            const vmask inside = lanes_before((item.first + v) * LANES, width);
            const ulong at = centre + v * LANES;
            lanes_store(lanes_if(inside, v_mean, zero), v_maps + at);
            lanes_store(lanes_if(inside, v_hs, zero), v_maps + at + 3 * plane);
            lanes_store(lanes_if(inside, v_hd, zero), v_maps + at + 6 * plane);
            const vreal error = lanes_load(rendered + at) - truth_load(truth + at);  // 0 outside
            const vreal size = fabs(error), slope = min(size * steepness, (vreal)1);
            smooth = lanes_mad(slope, lanes_mad(R(-0.5) * beta, slope, size), smooth);
            ssims += lanes_if(inside, ssim, zero);
            l1 += size;
            squares = lanes_mad(error, error, squares);
        }
    }
    const ulong n_parts = strips * get_global_size(1) * get_global_size(2);
    const ulong part = (get_global_id(2) * get_global_size(1) + get_global_id(1)) * strips + get_global_id(0);
    partial[part] = lanes_sum(smooth);
    partial[n_parts + part] = lanes_sum(ssims);
    partial[2 * n_parts + part] = lanes_sum(l1);
    partial[3 * n_parts + part] = lanes_sum(squares);
}

// Overwrites v_color with the gradient of the loss. It blurs v_maps, because a symmetric window is its own adjoint.
// l1_scale = (1 - lambda) / count, ssim_scale = lambda / count.
kernel void image_loss_vjp(
    global const real *restrict rendered,
    global const uchar *restrict truth,
    global const real *restrict v_maps,
    global real *restrict v_color,
    int width,
    int height,
    int stride,
    ulong plane,
    int segment,
    real steepness,
    real l1_scale,
    real ssim_scale
) {
    if (get_global_id(0) >= strips_of(stride)) return;
    const strip item = item_strip(height, stride, plane, segment);
    vreal ring[RING][STRIP][3];
    const vreal zero = (vreal)0;
    int slot = 0;
    for (int row = item.top - REACH; row < item.end + REACH; ++row) {
        MOVE_UP(3)
        if (row >= 0 && row < height) {
            global const real *from = v_maps + item.at + (long)row * stride;
            for (int v = 0; v < item.n; ++v, from += LANES) {
                global const real *hs = from + 3 * plane, *hd = from + 6 * plane;
                vreal v_mean = WINDOW_5 * lanes_load(from);
                vreal v_hs = WINDOW_5 * lanes_load(hs), v_hd = WINDOW_5 * lanes_load(hd);
#define ADD_PAIR(w, k) \
    v_mean = lanes_mad(w, lanes_load(from - k) + lanes_load(from + k), v_mean); \
    v_hs = lanes_mad(w, lanes_load(hs - k) + lanes_load(hs + k), v_hs); \
    v_hd = lanes_mad(w, lanes_load(hd - k) + lanes_load(hd + k), v_hd);
                PAIRS_OF_WINDOW(ADD_PAIR)
#undef ADD_PAIR
                PUT(0, v_mean);
                PUT(1, v_hs);
                PUT(2, v_hd);
            }
        } else {
            for (int v = 0; v < item.n; ++v)
                for (int map = 0; map < 3; ++map) PUT(map, zero);
        }
        slot = SHIFT || slot == TAPS - 1 ? 0 : slot + 1;
        if (row < item.top + REACH) continue;
        const ulong centre = item.at + (long)(row - REACH) * stride;
        for (int v = 0; v < item.n; ++v) {
            vreal v_mean = WINDOW_5 * ring[MID][v][0];
            vreal v_hs = WINDOW_5 * ring[MID][v][1], v_hd = WINDOW_5 * ring[MID][v][2];
#define ADD_PAIR(w, k) \
    v_mean = lanes_mad(w, ring[MID - k][v][0] + ring[MID + k][v][0], v_mean); \
    v_hs = lanes_mad(w, ring[MID - k][v][1] + ring[MID + k][v][1], v_hs); \
    v_hd = lanes_mad(w, ring[MID - k][v][2] + ring[MID + k][v][2], v_hd);
            PAIRS_OF_WINDOW(ADD_PAIR)
#undef ADD_PAIR
            const ulong at = centre + v * LANES;
            const vreal x = lanes_load(rendered + at), y = truth_load(truth + at);
            const vreal v_ssim = lanes_mad(x + y, v_hs, lanes_mad(x - y, v_hd, v_mean));
            const vreal slope = max(min((x - y) * steepness, (vreal)1), (vreal)-1);
            lanes_store(
                lanes_if(lanes_before((item.first + v) * LANES, width), l1_scale * slope - ssim_scale * v_ssim, zero),
                v_color + at
            );
        }
    }
}
