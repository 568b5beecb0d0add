// raster.cl: blend the isects of each tile front to back, and the gradient of that.
//
// One group of GROUP work-items per tile of TILE x TILE pixels; each item owns VECS runs ("rows") of LANES pixels,
// so GROUP * VECS * LANES = TILE * TILE. Run number r = v * GROUP + item: CPU schedules walk a splat's own rows
// with accumulators in L1, GPU schedules (VECS = 1) keep one pixel in registers. Splats come in batches of BATCH,
// staged in local memory. Images are planar with a margin: plane c, pixel (x, y) at
// c * plane + (y + MARGIN_Y) * stride + x + MARGIN_X; pixels beyond width or height are written as 0.

#define RUNS_PER_ROW (TILE / LANES)
#define V_RECORD (SHAPE_V + 3)

// Copies a batch of records; `lists` holds isect ids in depth order.
static inline void stage_batch(global const uint *lists, global const uint *isect_splat, global const real *records,
                        uint start, int n, local real *batch) {
    for (int k = LID; k < n; k += GROUP) {
        global const real *from = records + (ulong)isect_splat[lists[start + k]] * RECORD;
        for (int j = 0; j < RECORD; ++j) batch[k * RECORD + j] = from[j];
    }
    group_barrier();
}

// Transmittance before any splat; pixels outside the image count as finished.
static inline vreal fresh_T(int x, int y, int width, int height) {
    const vmask inside = ((vreal)x + lanes_iota() < (vreal)width) & lanes_mask(y < height);
    return lanes_if(inside, (vreal)1, (vreal)-1);
}

// Runs [first, last) of this item that the splat's pixel rows can touch.
static inline int first_run(const real *rec, int tile_y) {
    const int row = max((int)rec[6] - tile_y, 0);
    return row * RUNS_PER_ROW / GROUP;
}
static inline int past_run(const real *rec, int tile_y) {
    const int rows = min((int)rec[7] - tile_y + 1, TILE);
    return (rows * RUNS_PER_ROW + GROUP - 1) / GROUP;
}

// What the forward tells the gradient about an isect: the runs in which it met a live pixel, a bit each. Where a work-item
// has them all, and in vectors: of a group each item would know its own only.
#define TELLS_RUNS (GROUP == 1 && LANES > 1)

// color [3 planes], transmittance [plane] (final T), depth [plane] (sum of weight * z; only if WITH_DEPTH).
// isect_runs [n_isects], by unsorted isect id: see TELLS_RUNS.
GROUP_ATTRIBUTE
kernel void rasterize(
    global const uint2 *restrict tile_ranges,
    global const uint *restrict lists,
    global const uint *restrict isect_splat,
    global const real *restrict records,
    global real *restrict color,
    global real *restrict transmittance,
    global real *restrict depth,
    global uint *restrict isect_runs,
    int width,
    int height,
    int tiles_x,
    int stride,
    ulong plane,
    real background_r,
    real background_g,
    real background_b)
{
    local real batch[BATCH * RECORD];
    local real scratch[GROUP_SCRATCH(1)];
    const int tile = get_group_id(0);
    const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;
    const uint2 range = tile_ranges[tile];

    vreal T[VECS], red[VECS], green[VECS], blue[VECS];
#if WITH_DEPTH
    vreal z[VECS];
#endif
    for (int v = 0; v < VECS; ++v) {
        const int run = v * GROUP + LID;
        const int x = tile_x + run % RUNS_PER_ROW * LANES, y = tile_y + run / RUNS_PER_ROW;
        T[v] = fresh_T(x, y, width, height);
        red[v] = green[v] = blue[v] = (vreal)0;
#if WITH_DEPTH
        z[v] = (vreal)0;
#endif
    }

    for (uint start = range.x; start < range.y; start += BATCH) {
        const int n = min((int)(range.y - start), BATCH);
        stage_batch(lists, isect_splat, records, start, n, batch);
        for (int k = 0; k < n; ++k) {
            real rec[RECORD];
            for (int j = 0; j < RECORD; ++j) rec[j] = batch[k * RECORD + j];
            const int past = past_run(rec, tile_y);
#if TELLS_RUNS
            vmask changed = lanes_mask(0);
#endif
            for (int v = first_run(rec, tile_y); v < past; ++v) {
                const int run = v * GROUP + LID;
                const real x = tile_x + run % RUNS_PER_ROW * LANES + R(0.5) - rec[0];
                const real dy = tile_y + run / RUNS_PER_ROW + R(0.5) - rec[1];
                shape_pixel pixel;
                vreal alpha = shape_alpha((vreal)x + lanes_iota(), dy, rec + 8, &pixel);
                const vreal T_before = T[v];
                vmask hit;
                const vreal weight = blend(&alpha, &T[v], &hit);
#if TELLS_RUNS
                changed |= (hit | (T[v] != T_before)) & (mask_int)(1 << v);
#endif
                red[v] = lanes_mad(weight, (vreal)rec[2], red[v]);
                green[v] = lanes_mad(weight, (vreal)rec[3], green[v]);
                blue[v] = lanes_mad(weight, (vreal)rec[4], blue[v]);
#if WITH_DEPTH
                z[v] = lanes_mad(weight, (vreal)rec[5], z[v]);
#endif
            }
#if TELLS_RUNS
            isect_runs[lists[start + k]] = (uint)lanes_or(changed);
#endif
        }
        int any_live = 0;
        for (int v = 0; v < VECS && !any_live; ++v) any_live = lanes_any(lanes_not(BLEND_DONE(T[v])));
        if (!group_any(any_live, scratch)) break;
    }

    for (int v = 0; v < VECS; ++v) {
        const int run = v * GROUP + LID;
        const int x = tile_x + run % RUNS_PER_ROW * LANES, y = tile_y + run / RUNS_PER_ROW;
        const vmask inside = ((vreal)x + lanes_iota() < (vreal)width) & lanes_mask(y < height);
        const ulong at = (ulong)(y + MARGIN_Y) * stride + x + MARGIN_X;
        const vreal zero = (vreal)0;
        T[v] = fabs(T[v]);
        lanes_store(lanes_if(inside, lanes_mad(T[v], (vreal)background_r, red[v]), zero), color + at);
        lanes_store(lanes_if(inside, lanes_mad(T[v], (vreal)background_g, green[v]), zero), color + at + plane);
        lanes_store(lanes_if(inside, lanes_mad(T[v], (vreal)background_b, blue[v]), zero), color + at + 2 * plane);
        lanes_store(lanes_if(inside, T[v], zero), transmittance + at);
#if WITH_DEPTH
        lanes_store(lanes_if(inside, z[v], zero), depth + at);
#endif
    }
}

// Replays the blending front to back. With w_j = alpha_j T_j and g_j = c_j . v_color, the loss depends on alpha_i
// through T_i g_i - (sum_{j>i} w_j g_j + T_final (background . v_color - v_alpha)) / (1 - alpha_i).
// isect_grads [n_isects, V_RECORD], by unsorted isect id: moments of the shape, then the gradient of the colour.
// Overwrites every record of every isect.
GROUP_ATTRIBUTE
kernel void rasterize_vjp(
    global const uint2 *restrict tile_ranges,
    global const uint *restrict lists,
    global const uint *restrict isect_splat,
    global const real *restrict records,
    global const real *restrict color,
    global const real *restrict transmittance,
    global const real *restrict v_color,
    global const real *restrict v_alpha,
    global const uint *restrict isect_runs,
    global real *restrict isect_grads,
    int width,
    int height,
    int tiles_x,
    int stride,
    ulong plane)
{
    local real batch[BATCH * RECORD];
    local real scratch[GROUP_SCRATCH(V_RECORD)];
    const int tile = get_group_id(0);
    const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;
    const uint2 range = tile_ranges[tile];

    vreal T[VECS], rest[VECS], v_red[VECS], v_green[VECS], v_blue[VECS];
    for (int v = 0; v < VECS; ++v) {
        const int run = v * GROUP + LID;
        const int x = tile_x + run % RUNS_PER_ROW * LANES, y = tile_y + run / RUNS_PER_ROW;
        const ulong at = (ulong)(y + MARGIN_Y) * stride + x + MARGIN_X;
        T[v] = fresh_T(x, y, width, height);
        v_red[v] = lanes_load(v_color + at);
        v_green[v] = lanes_load(v_color + at + plane);
        v_blue[v] = lanes_load(v_color + at + 2 * plane);
        rest[v] = v_red[v] * lanes_load(color + at) + v_green[v] * lanes_load(color + at + plane)
                + v_blue[v] * lanes_load(color + at + 2 * plane);
#if WITH_V_ALPHA
        rest[v] -= lanes_load(transmittance + at) * lanes_load(v_alpha + at);
#endif
    }

    bool finished = false;
    for (uint start = range.x; start < range.y; start += BATCH) {
        const int n = min((int)(range.y - start), BATCH);
        if (finished) {  // uniform over the group
            for (int k = LID; k < n; k += GROUP)
                for (int j = 0; j < V_RECORD; ++j) isect_grads[(ulong)lists[start + k] * V_RECORD + j] = 0;
            continue;
        }
        stage_batch(lists, isect_splat, records, start, n, batch);
        for (int k = 0; k < n; ++k) {
            real rec[RECORD];
            for (int j = 0; j < RECORD; ++j) rec[j] = batch[k * RECORD + j];
            vreal sums[V_RECORD];
            for (int j = 0; j < V_RECORD; ++j) sums[j] = (vreal)0;
#if TELLS_RUNS
            const uint told = isect_runs[lists[start + k]];
            const int first = popcount((told & -told) - 1u), past = 32 - clz(told);
#else
            const int first = first_run(rec, tile_y), past = past_run(rec, tile_y);
#endif
            for (int v = first; v < past; ++v) {
                const int run = v * GROUP + LID;
                const vreal dx = (vreal)(tile_x + run % RUNS_PER_ROW * LANES + R(0.5) - rec[0]) + lanes_iota();
                const real dy = tile_y + run / RUNS_PER_ROW + R(0.5) - rec[1];
                shape_pixel pixel;
                const vreal raw_alpha = shape_alpha(dx, dy, rec + 8, &pixel);
                vreal alpha = raw_alpha;
                const vreal T_before = T[v];
                vmask hit;
                const vreal weight = blend(&alpha, &T[v], &hit);
                const vreal g = lanes_mad(v_red[v], rec[2], lanes_mad(v_green[v], rec[3], v_blue[v] * rec[4]));
                rest[v] = lanes_mad(-weight, g, rest[v]);
                const vreal v_a = lanes_mad(T_before, g, -rest[v] / ((vreal)1 - alpha));
                shape_alpha_vjp(dx, dy, rec + 8, pixel, lanes_if(hit, blend_clamp_vjp(raw_alpha, v_a), (vreal)0),
                                sums);
                sums[SHAPE_V] = lanes_mad(weight, v_red[v], sums[SHAPE_V]);
                sums[SHAPE_V + 1] = lanes_mad(weight, v_green[v], sums[SHAPE_V + 1]);
                sums[SHAPE_V + 2] = lanes_mad(weight, v_blue[v], sums[SHAPE_V + 2]);
            }
            real own[V_RECORD];
            for (int j = 0; j < V_RECORD; ++j) own[j] = lanes_sum(sums[j]);
            group_sum_store(own, V_RECORD, scratch, isect_grads + (ulong)lists[start + k] * V_RECORD);
        }
        int any_live = 0;
        for (int v = 0; v < VECS && !any_live; ++v) any_live = lanes_any(lanes_not(BLEND_DONE(T[v])));
        finished = !group_any(any_live, scratch);
    }
}

// moments [V_RECORD, capacity]: each splat's isects summed in order. Overwrites, or goes on with the sum that is there.
kernel void gather_isect_grads(
    global const uint2 *restrict splat_isects,
    global const real *restrict isect_grads,
    global real *restrict moments,
    ulong capacity,
    uint n_splats,
    int go_on)
{
    const uint i = get_global_id(0);
    if (i >= n_splats) return;
    real sums[V_RECORD];
    for (int j = 0; j < V_RECORD; ++j) sums[j] = go_on ? moments[i + j * capacity] : 0;
    const uint2 range = splat_isects[i];
    for (uint isect = range.x; isect < range.y; ++isect)
        for (int j = 0; j < V_RECORD; ++j) sums[j] += isect_grads[(ulong)isect * V_RECORD + j];
    for (int j = 0; j < V_RECORD; ++j) moments[i + j * capacity] = sums[j];
}
