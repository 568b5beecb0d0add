// raster.cl: blend the isects of each tile front to back, and the gradient of that.
//
// One group of GROUP work-items per tile of TILE x TILE pixels; each item owns VECS blocks of LANES pixels (cl/math/lanes.clh),
// so GROUP * VECS * LANES = TILE * TILE. Block number b = v * GROUP + item, rows of blocks one after another: CPU schedules
// walk the blocks that a splat reaches with accumulators in L1, GPU schedules (VECS = 1) keep one pixel in registers.
// Splats come in batches of BATCH. Images are planar with a margin: plane c, pixel (x, y) at
// c * plane + (y + MARGIN_Y) * stride + x + MARGIN_X; pixels beyond width or height are written as 0.

#define BLOCKS_X (TILE / BLOCK_W)
#define V_RECORD (SHAPE_V + 3)

#ifndef SHAPE_PLAIN  // no splat of such a shape is a Gaussian at less cost
#define shape_is_plain(p) false
#define shape_alpha_plain(dx, dy, p) ((vreal)0)
#define shape_alpha_plain_vjp(dx, dy, alpha, v_alpha, v)
#define shape_sums_plain(sums)
#endif

// The screen records of a batch; `lists` holds isect ids in depth order. A group copies them to local memory; a single
// work-item has them in its cache already and keeps where they are.
#if ALONE
typedef global const real *staged_record;
#define BATCH_MEMORY uint batch[BATCH]
static inline void stage_batch(
    global const uint *lists,
    global const uint *isect_splat,
    global const real *records,
    uint start,
    int n,
    uint *batch
) {
    for (int k = 0; k < n; ++k) {
        batch[k] = isect_splat[lists[start + k]];
        prefetch_reals(records + (ulong)batch[k] * RECORD, RECORD);
    }
}
#define batch_record(k) (records + (ulong)batch[k] * RECORD)
#else
typedef local const real *staged_record;
#define BATCH_MEMORY local real batch[BATCH * RECORD]
static inline void stage_batch(
    global const uint *lists,
    global const uint *isect_splat,
    global const real *records,
    uint start,
    int n,
    local real *batch
) {
    for (int k = LID; k < n; k += GROUP) {
        global const real *from = records + (ulong)isect_splat[lists[start + k]] * RECORD;
        for (int j = 0; j < RECORD; ++j) batch[k * RECORD + j] = from[j];
    }
    group_barrier();
}
#define batch_record(k) (batch + (k) * RECORD)
#endif
static inline void read_record(staged_record from, real *rec) {
    UNROLL for (int j = 0; j < RECORD; ++j) rec[j] = from[j];
}

// Column and row of a block's first pixel.
static inline int block_column(int tile_x, int v) { return tile_x + (v * GROUP + LID) % BLOCKS_X * BLOCK_W; }
static inline int block_row(int tile_y, int v) { return tile_y + (v * GROUP + LID) / BLOCKS_X * BLOCK_H; }
static inline ulong block_at(int x, int y, int stride) { return (ulong)(y + MARGIN_Y) * stride + x + MARGIN_X; }

// Centres of an item's pixels [px]; transmittance before any splat: pixels outside the image count as finished.
static inline void start_blocks(int tile_x, int tile_y, int width, int height, vreal *px, vreal *py, vreal *T) {
    for (int v = 0; v < VECS; ++v) {
        px[v] = (vreal)(block_column(tile_x, v) + R(0.5)) + lanes_block_x();
        py[v] = (vreal)(block_row(tile_y, v) + R(0.5)) + lanes_block_y();
        T[v] = lanes_if((px[v] < (vreal)width) & (py[v] < (vreal)height), (vreal)1, (vreal)-1);
    }
}

// The blocks of an item that a splat can reach. Where a work-item has all of the tile's, and in vectors: a bit each, those in
// the splat's box that shape_reaches, tested LANES blocks at once. The forward keeps them for the gradient (isect_blocks).
// Elsewhere first and past-the-end of those in the splat's pixel rows.
#define CULLS_BLOCKS (ALONE && LANES > 1)
#if CULLS_BLOCKS

#define BITS 32
typedef uint block_set;
#define no_blocks_left(set) ((set) == 0)
#define next_block(set) (BITS - 1 - (int)clz((set) & -(set)))
#define without_next(set) ((set) & ((set) - 1))
#define PARTS ((VECS + LANES - 1) / LANES)  // vectors of blocks

// Columns and rows of the first pixels of LANES blocks from number `first` on.
static inline vreal corners_x(int first) {
    const vreal number = lanes_iota() + (vreal)first;
    return (number - (real)BLOCKS_X * floor(number * (R(1.0) / BLOCKS_X))) * (real)BLOCK_W;
}
static inline vreal corners_y(int first) {
    return floor((lanes_iota() + (vreal)first) * (R(1.0) / BLOCKS_X)) * (real)BLOCK_H;
}

static inline block_set blocks_reached(const real *rec, int tile_x, int tile_y) {
    vmask bits = lanes_mask(0);
    UNROLL for (int part = 0; part < PARTS; ++part) {
        const int first = part * LANES, top = tile_y + first / BLOCKS_X * BLOCK_H;
        if (PARTS == 1 || (rec[7] >= (real)top && rec[6] < (real)(top + LANES / BLOCKS_X * BLOCK_H))) {
            const vreal x = corners_x(first) + (vreal)tile_x, y = corners_y(first) + (vreal)tile_y;
            const vmask in_box = (x <= (vreal)rec[9]) & (x + (real)(BLOCK_W - 1) >= (vreal)rec[8])
                                 & (y <= (vreal)rec[7]) & (y + (real)(BLOCK_H - 1) >= (vreal)rec[6]);
            const vreal dx = x + R(0.5) * BLOCK_W - rec[0], dy = y + R(0.5) * BLOCK_H - rec[1];
            bits |= in_box & shape_reaches(dx, dy, rec + HEAD) & lanes_bits(first);
        }
    }
    const block_set reached = (block_set)(uint)lanes_or(bits);
    return reached & (~(block_set)0 >> (BITS - VECS));  // fewer blocks than lanes: the rest lies outside of the tile
}

// Blocks with a pixel that is not finished.
static inline block_set live_blocks(const vreal *T) {
    block_set live = 0;
    for (int v = 0; v < VECS; ++v) live |= (block_set)(lanes_any(lanes_not(BLEND_DONE(T[v]))) ? 1 : 0) << v;
    return live;
}

#else

typedef int2 block_set;
#define no_blocks_left(set) ((set).x >= (set).y)
#define next_block(set) ((set).x)
#define without_next(set) ((set) + (int2)(1, 0))

static inline block_set blocks_reached(const real *rec, int tile_x, int tile_y) {
    const int top = max((int)rec[6] - tile_y, 0) / BLOCK_H, bottom = min((int)rec[7] - tile_y, TILE - 1) / BLOCK_H;
    return (int2)(top * BLOCKS_X / GROUP, ((bottom + 1) * BLOCKS_X + GROUP - 1) / GROUP);
}

#endif

// Whether any pixel of the item is not finished.
static inline int any_live(const vreal *T) {
    int live = 0;
    for (int v = 0; v < VECS && !live; ++v) live = lanes_any(lanes_not(BLEND_DONE(T[v])));
    return live;
}

// color [3 planes], transmittance [plane] (final T), depth [plane] (sum of weight * z; only if WITH_DEPTH).
// isect_blocks [n_isects], by unsorted isect id, only where CULLS_BLOCKS: the blocks in which it was blended.
GROUP_ATTRIBUTE
kernel void rasterize(
    global const uint2 *restrict tile_ranges,
    global const uint *restrict lists,
    global const uint *restrict isect_splat,
    global const real *restrict records,
    global real *restrict color,
    global real *restrict transmittance,
    global real *restrict depth,
    global uint *restrict isect_blocks,
    int width,
    int height,
    int tiles_x,
    int stride,
    ulong plane,
    real background_r,
    real background_g,
    real background_b
) {
    BATCH_MEMORY;
    local real scratch[GROUP_SCRATCH(1)];
    const int tile = get_group_id(0);
    const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;
    const uint2 range = tile_ranges[tile];

    vreal px[VECS], py[VECS], T[VECS], red[VECS], green[VECS], blue[VECS];
    start_blocks(tile_x, tile_y, width, height, px, py, T);
#if WITH_DEPTH
    vreal z[VECS];
#endif
    for (int v = 0; v < VECS; ++v) {
        red[v] = green[v] = blue[v] = (vreal)0;
#if WITH_DEPTH
        z[v] = (vreal)0;
#endif
    }

    for (uint start = range.x; start < range.y; start += BATCH) {
        const int n = min((int)(range.y - start), BATCH);
#if CULLS_BLOCKS
        const block_set live = live_blocks(T);
        if (!live) break;
#else
        if (!group_any(any_live(T), scratch)) break;
#endif
        stage_batch(lists, isect_splat, records, start, n, batch);
#if CULLS_BLOCKS  // all first: the loop below then knows at once where to go
        block_set reached[BATCH];
        for (int k = 0; k < n; ++k) {
            real rec[RECORD];
            read_record(batch_record(k), rec);
            reached[k] = blocks_reached(rec, tile_x, tile_y) & live;
            isect_blocks[lists[start + k]] = reached[k];
        }
#endif
        for (int k = 0; k < n; ++k) {
            real rec[RECORD];
            read_record(batch_record(k), rec);
#if CULLS_BLOCKS
            block_set blocks = reached[k];
#else
            block_set blocks = blocks_reached(rec, tile_x, tile_y);
#endif
            // Alpha of all blocks before any is blended: a CPU holds fewer operations in flight than one block's chain from
            // pixel to transmittance has, and two short chains keep it busier than a long one.
            vreal alphas[VECS];
            if (shape_is_plain(rec + HEAD))
                for (block_set set = blocks; !no_blocks_left(set); set = without_next(set)) {
                    const int v = next_block(set);
                    alphas[v] = shape_alpha_plain(px[v] - rec[0], py[v] - rec[1], rec + HEAD);
                }
            else
                for (block_set set = blocks; !no_blocks_left(set); set = without_next(set)) {
                    const int v = next_block(set);
                    shape_pixel pixel;
                    alphas[v] = shape_alpha(px[v] - rec[0], py[v] - rec[1], rec + HEAD, &pixel);
                }
            for (; !no_blocks_left(blocks); blocks = without_next(blocks)) {
                const int v = next_block(blocks);
                vreal alpha = alphas[v];
                vmask hit;
                const vreal weight = blend(&alpha, &T[v], &hit);
                red[v] = lanes_mad(weight, (vreal)rec[2], red[v]);
                green[v] = lanes_mad(weight, (vreal)rec[3], green[v]);
                blue[v] = lanes_mad(weight, (vreal)rec[4], blue[v]);
#if WITH_DEPTH
                z[v] = lanes_mad(weight, (vreal)rec[5], z[v]);
#endif
            }
        }
    }

    for (int v = 0; v < VECS; ++v) {
        const vmask inside = (px[v] < (vreal)width) & (py[v] < (vreal)height);
        const ulong at = block_at(block_column(tile_x, v), block_row(tile_y, v), stride);
        const vreal zero = (vreal)0;
        T[v] = fabs(T[v]);
        lanes_store_block(lanes_if(inside, lanes_mad(T[v], (vreal)background_r, red[v]), zero), color + at, stride);
        lanes_store_block(
            lanes_if(inside, lanes_mad(T[v], (vreal)background_g, green[v]), zero), color + at + plane, stride
        );
        lanes_store_block(
            lanes_if(inside, lanes_mad(T[v], (vreal)background_b, blue[v]), zero), color + at + 2 * plane, stride
        );
        lanes_store_block(lanes_if(inside, T[v], zero), transmittance + at, stride);
#if WITH_DEPTH
        lanes_store_block(lanes_if(inside, z[v], zero), depth + at, stride);
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
    global const uint *restrict isect_blocks,
    global real *restrict isect_grads,
    int width,
    int height,
    int tiles_x,
    int stride,
    ulong plane
) {
    BATCH_MEMORY;
    local real scratch[GROUP_SCRATCH(V_RECORD)];
    const int tile = get_group_id(0);
    const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;
    const uint2 range = tile_ranges[tile];

    vreal px[VECS], py[VECS], T[VECS], rest[VECS], v_red[VECS], v_green[VECS], v_blue[VECS];
    start_blocks(tile_x, tile_y, width, height, px, py, T);
    for (int v = 0; v < VECS; ++v) {
        const ulong at = block_at(block_column(tile_x, v), block_row(tile_y, v), stride);
        v_red[v] = lanes_load_block(v_color + at, stride);
        v_green[v] = lanes_load_block(v_color + at + plane, stride);
        v_blue[v] = lanes_load_block(v_color + at + 2 * plane, stride);
        rest[v] = v_red[v] * lanes_load_block(color + at, stride)
                  + v_green[v] * lanes_load_block(color + at + plane, stride)
                  + v_blue[v] * lanes_load_block(color + at + 2 * plane, stride);
#if WITH_V_ALPHA
        rest[v] -= lanes_load_block(transmittance + at, stride) * lanes_load_block(v_alpha + at, stride);
#endif
    }

    bool finished = false;
    for (uint start = range.x; start < range.y; start += BATCH) {
        const int n = min((int)(range.y - start), BATCH);
        finished = finished || !group_any(any_live(T), scratch);
        if (finished) {  // uniform over the group
            for (int k = LID; k < n; k += GROUP)
                for (int j = 0; j < V_RECORD; ++j) isect_grads[(ulong)lists[start + k] * V_RECORD + j] = 0;
            continue;
        }
        stage_batch(lists, isect_splat, records, start, n, batch);
        for (int k = 0; k < n; ++k) {
            real rec[RECORD];
            read_record(batch_record(k), rec);
            vreal sums[V_RECORD];
            UNROLL for (int j = 0; j < V_RECORD; ++j) sums[j] = (vreal)0;
#if CULLS_BLOCKS
            block_set blocks = isect_blocks[lists[start + k]];
#else
            block_set blocks = blocks_reached(rec, tile_x, tile_y);
#endif
            vreal alphas[VECS];  // first, as above
            shape_pixel pixels[VECS];
            const bool plain = shape_is_plain(rec + HEAD);
            if (plain)
                for (block_set set = blocks; !no_blocks_left(set); set = without_next(set)) {
                    const int v = next_block(set);
                    alphas[v] = shape_alpha_plain(px[v] - rec[0], py[v] - rec[1], rec + HEAD);
                }
            else
                for (block_set set = blocks; !no_blocks_left(set); set = without_next(set)) {
                    const int v = next_block(set);
                    alphas[v] = shape_alpha(px[v] - rec[0], py[v] - rec[1], rec + HEAD, &pixels[v]);
                }
            for (; !no_blocks_left(blocks); blocks = without_next(blocks)) {
                const int v = next_block(blocks);
                const vreal dx = px[v] - rec[0], dy = py[v] - rec[1];
                const vreal raw_alpha = alphas[v];
                vreal alpha = raw_alpha;
                const vreal T_before = T[v];
                vmask hit;
                const vreal weight = blend(&alpha, &T[v], &hit);
                const vreal g = lanes_mad(v_red[v], rec[2], lanes_mad(v_green[v], rec[3], v_blue[v] * rec[4]));
                rest[v] = lanes_mad(-weight, g, rest[v]);
                const vreal v_a = lanes_mad(T_before, g, -rest[v] / ((vreal)1 - alpha));
                const vreal v_raw = lanes_if(hit, blend_clamp_vjp(raw_alpha, v_a), (vreal)0);
                if (plain) shape_alpha_plain_vjp(dx, dy, raw_alpha, v_raw, sums);
                else shape_alpha_vjp(dx, dy, rec + HEAD, pixels[v], v_raw, sums);
                sums[SHAPE_V] = lanes_mad(weight, v_red[v], sums[SHAPE_V]);
                sums[SHAPE_V + 1] = lanes_mad(weight, v_green[v], sums[SHAPE_V + 1]);
                sums[SHAPE_V + 2] = lanes_mad(weight, v_blue[v], sums[SHAPE_V + 2]);
            }
            real own[V_RECORD];
            lanes_sums(sums, V_RECORD, own);
            if (plain) shape_sums_plain(own);
            group_sum_store(own, V_RECORD, scratch, isect_grads + (ulong)lists[start + k] * V_RECORD);
        }
    }
}

// moments [V_RECORD, capacity]: each splat's isects summed in order. Overwrites, or goes on with the sum that is there.
// Global size: splats / LANES.
kernel void gather_isect_grads(
    global const uint2 *restrict splat_isects,
    global const real *restrict isect_grads,
    global real *restrict moments,
    ulong capacity,
    uint n_splats,
    int go_on
) {
    const uint first = get_global_id(0) * LANES;
    if (first >= n_splats) return;
    real sums[V_RECORD][LANES];
    for (uint l = 0; l < LANES; ++l) {
        const uint2 range = first + l < n_splats ? splat_isects[first + l] : (uint2)(0, 0);
        real own[V_RECORD];
        for (int j = 0; j < V_RECORD; ++j) own[j] = go_on ? moments[first + l + j * capacity] : 0;
        for (uint isect = range.x; isect < range.y; ++isect)
            UNROLL for (int j = 0; j < V_RECORD; ++j) own[j] += isect_grads[(ulong)isect * V_RECORD + j];
        for (int j = 0; j < V_RECORD; ++j) sums[j][l] = own[j];
    }
    for (int j = 0; j < V_RECORD; ++j) lanes_store(lanes_load(sums[j]), moments + first + j * capacity);
}
