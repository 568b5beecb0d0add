// rasterize.cl: blend the isects of each tile from front to back, and the gradient of that.
//
// The plain algorithm, for one pixel (px, py) of a tile:
//   T = 1, colour = 0
//   for each isect of the tile, in depth order:
//       alpha = shape_alpha(px - x, py - y, record)             // the shape's file
//       weight = blend(&alpha, &T, ...)                         // blend.clh: clamp, cutoff, update of T
//       colour += weight * (r, g, b), depth += weight * z
//   colour += T * background
// count.cl has this loop and nothing else. Here the loop is arranged for speed, with the same sums in the same order:
// - A group of GROUP work-items has one tile of TILE x TILE pixels. Each work-item has VECS blocks of LANES pixels of it:
//   GROUP * VECS * LANES = TILE * TILE. On CPUs one work-item keeps the accumulators of a tile in its first cache. On GPUs
//   a work-item keeps one to eight pixels in registers.
// - Isects come in batches of BATCH (batch.clh). The loop ends when no pixel of the tile is live.
// - An isect visits only the blocks that the splat can reach (blocks.clh).
// - On CPUs a pass computes alpha in all these blocks, and a second one blends. A CPU holds fewer operations in flight than
//   the chain from pixel to transmittance of one block has; two short chains keep it busier than a long one. On GPUs other
//   groups fill the gaps, and one pass needs fewer registers.
//
// Images are planar with a margin: plane c has pixel (x, y) at c * plane + (y + MARGIN_Y) * stride + x + MARGIN_X. Pixels of
// a tile beyond width or height are written as 0.

// A shape without a cheaper formula for some splats. Groups of work-items never use the cheaper formula: the test of each
// block costs more than it saves.
#ifndef SHAPE_PLAIN
#define shape_is_plain(p) false
#define shape_alpha_plain(dx, dy, p) ((vreal)0)
#define shape_alpha_plain_vjp(dx, dy, alpha, v_alpha, v)
#define shape_sums_plain(sums)
#endif

#ifndef SHAPE_COLUMN
static inline void shape_to_column(real dx, real *p) { form_to_column(dx, p + P_FORM); }
static inline void column_sums(real dx, vreal *v) { column_moments(dx, v + V_MOMENTS); }
#endif

static inline vreal pixel_alpha(vreal dx, vreal dy, const real *rec, bool plain, shape_pixel *pixel) {
    if (plain) return shape_alpha_plain(dx, dy, rec + HEAD);
    return shape_alpha(dx, dy, rec + HEAD, pixel);
}

// Writes alpha in each block of a set.
static inline void alpha_pass(
    block_set blocks,
    const vreal *px,
    const vreal *py,
    const real *rec,
    bool plain,
    vreal *alphas,
    shape_pixel *pixels
) {
    const real x = rec[HEAD_X], y = rec[HEAD_Y];
    if (plain) {
        for_blocks(v, blocks) alphas[v] = shape_alpha_plain(from_x(px, v, x), from_y(py, v, y), rec + HEAD);
    } else {
        for_blocks(v, blocks) alphas[v] = shape_alpha(from_x(px, v, x), from_y(py, v, y), rec + HEAD, &pixels[v]);
    }
}

// Overwrites color [3 planes], transmittance [plane] with the final T, and depth [plane] with the sum of weight * z.
// isect_blocks [n_isects], by unsorted isect id: CULLS_BLOCKS overwrites it with the set of blocks in which the isect was
// blended; CULLS_STRIPS reads the set of strips that its splat reaches (strips.clh).
GROUP_ATTRIBUTE
kernel void rasterize(
    global const uint2 *restrict tile_ranges,
    global const uint *restrict lists,
    global const uint *restrict isect_splat,
    global const real *restrict records,
    global real *restrict color,
    global real *restrict transmittance,
#if WITH_DEPTH
    global real *restrict depth,
#endif
#if CULLS_BLOCKS
    global uint *restrict isect_blocks,
#endif
#if CULLS_STRIPS
    global const uint *restrict isect_blocks,
#endif
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
    local real scratch[1];
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
        stage_records(start, n);
#if CULLS_BLOCKS  // for the whole batch first: the processor then knows early which blocks come next
        block_set reached[BATCH];
        for (int k = 0; k < n; ++k) {
            real rec[RECORD_STRIDE];
            read_record(k, rec);
            reached[k] = blocks_reached(rec, tile_x, tile_y) & live;
            isect_blocks[lists[start + k]] = reached[k];
        }
#endif
        for (int k = 0; k < n; ++k) {
#if CULLS_STRIPS
            const block_set blocks = strips[k];
            if (!blocks) continue;  // uniform over the group
#endif
            real rec[RECORD_STRIDE];
            read_record(k, rec);
#if CULLS_BLOCKS
            const block_set blocks = reached[k];
#elif !CULLS_STRIPS
            const block_set blocks = blocks_reached(rec, tile_x, tile_y);
#endif
#if COLUMNS
            const real column_dx = from_x(px, 0, rec[HEAD_X]);
            shape_to_column(column_dx, rec + HEAD);
#endif
            const bool plain = ALONE && shape_is_plain(rec + HEAD);
            vreal alphas[VECS];
            shape_pixel pixels[VECS];
            if (ALONE) alpha_pass(blocks, px, py, rec, plain, alphas, pixels);
            for_blocks(v, blocks) {
                const vreal dx = from_x(px, v, rec[HEAD_X]), dy = from_y(py, v, rec[HEAD_Y]);
                vreal alpha = ALONE ? alphas[v] : pixel_alpha(dx, dy, rec, plain, &pixels[v]);
                vmask hit;
                const vreal weight = blend(&alpha, &T[v], &hit);
                red[v] = lanes_mad(weight, (vreal)rec[HEAD_RED], red[v]);
                green[v] = lanes_mad(weight, (vreal)rec[HEAD_GREEN], green[v]);
                blue[v] = lanes_mad(weight, (vreal)rec[HEAD_BLUE], blue[v]);
#if WITH_DEPTH
                z[v] = lanes_mad(weight, (vreal)rec[HEAD_DEPTH], z[v]);
#endif
            }
        }
    }

    for (int v = 0; v < VECS; ++v) {
        const vmask inside = (from_x(px, v, width) < (vreal)0) & (from_y(py, v, height) < (vreal)0);
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

static inline void zero_grads(global real *grads) {
    for (int j = 0; j < V_RECORD; ++j) grads[j] = 0;
}

// Repeats the blending from front to back. With w_j = alpha_j T_j and g_j = c_j . v_color, the gradient of alpha_i is
//   T_i g_i - (sum_{j>i} w_j g_j + T_final (background . v_color - v_alpha)) / (1 - alpha_i).
// `rest` holds the sum in the brackets. Overwrites isect_grads [n_isects, V_RECORD], by unsorted isect id: moments of the
// shape, then the gradient of the colour.
GROUP_ATTRIBUTE
kernel void rasterize_vjp(
    global const uint2 *restrict tile_ranges,
    global const uint *restrict lists,
    global const uint *restrict isect_splat,
    global const real *restrict records,
    global const real *restrict color,
    global const real *restrict transmittance,
    global const real *restrict v_color,
#if WITH_V_ALPHA
    global const real *restrict v_alpha,
#endif
#if CULLS_BLOCKS
    global const uint *restrict isect_blocks,
#endif
#if CULLS_STRIPS
    global const uint *restrict isect_blocks,
#endif
    global real *restrict isect_grads,
    int width,
    int height,
    int tiles_x,
    int stride,
    ulong plane
) {
    BATCH_MEMORY;
    local real scratch[1];
    SUMS_MEMORY(V_RECORD);
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
            for (int k = LID; k < n; k += GROUP) zero_grads(isect_grads + (ulong)lists[start + k] * V_RECORD);
            continue;
        }
        stage_records(start, n);
#if CULLS_STRIPS
        for (int k = LID; k < n; k += GROUP)
            if (!strips[k]) zero_grads(isect_grads + (ulong)batch_isect(k) * V_RECORD);
#endif
        for (int k = 0; k < n; ++k) {
#if CULLS_STRIPS
            const block_set blocks = strips[k];
            if (!blocks) continue;  // uniform over the group
#endif
            real rec[RECORD_STRIDE];
            read_record(k, rec);
            vreal sums[V_RECORD];
            UNROLL for (int j = 0; j < V_RECORD; ++j) sums[j] = (vreal)0;
#if CULLS_BLOCKS
            const block_set blocks = isect_blocks[lists[start + k]];
#elif !CULLS_STRIPS
            const block_set blocks = blocks_reached(rec, tile_x, tile_y);
#endif
#if COLUMNS
            const real column_dx = from_x(px, 0, rec[HEAD_X]);
            shape_to_column(column_dx, rec + HEAD);
#endif
            const bool plain = ALONE && shape_is_plain(rec + HEAD);
            vreal alphas[VECS];
            shape_pixel pixels[VECS];
            if (ALONE) alpha_pass(blocks, px, py, rec, plain, alphas, pixels);
            for_blocks(v, blocks) {
                const vreal dx = from_x(px, v, rec[HEAD_X]), dy = from_y(py, v, rec[HEAD_Y]);
                const vreal raw_alpha = ALONE ? alphas[v] : pixel_alpha(dx, dy, rec, plain, &pixels[v]);
                vreal alpha = raw_alpha;
                const vreal T_before = T[v];
                vmask hit;
                const vreal weight = blend(&alpha, &T[v], &hit);
                const vreal g = lanes_mad(
                    v_red[v], rec[HEAD_RED], lanes_mad(v_green[v], rec[HEAD_GREEN], v_blue[v] * rec[HEAD_BLUE])
                );
                rest[v] = lanes_mad(-weight, g, rest[v]);
                const vreal v_a = lanes_mad(T_before, g, pixel_ratio(-rest[v], (vreal)1 - alpha));
                const vreal v_raw = blend_clamp_vjp(raw_alpha, hit, v_a);
                if (plain) shape_alpha_plain_vjp(dx, dy, raw_alpha, v_raw, sums);
                else shape_alpha_vjp(dx, dy, rec + HEAD, pixels[v], v_raw, sums);
                sums[SHAPE_V] = lanes_mad(weight, v_red[v], sums[SHAPE_V]);
                sums[SHAPE_V + 1] = lanes_mad(weight, v_green[v], sums[SHAPE_V + 1]);
                sums[SHAPE_V + 2] = lanes_mad(weight, v_blue[v], sums[SHAPE_V + 2]);
            }
#if COLUMNS
            column_sums(column_dx, sums);
#endif
            real item_sums[V_RECORD];  // over the blocks of this work-item
            lanes_sums(sums, V_RECORD, item_sums);
            if (plain) shape_sums_plain(item_sums);
            sums_store(item_sums, V_RECORD, batch_isect(k), isect_grads);
        }
        sums_finish(V_RECORD, isect_grads);
    }
}
