// count.cl: the number of useful pairs of splat and pixel in a frame, for benchmarks and overdraw images.
//
// A pair is useful if |alpha| reaches the cutoff and no earlier splat has finished the pixel. The pair that finishes
// the pixel counts. This is the loop of rasterize.cl for one block, without batches and without culled blocks.

#define BLOCKS_PER_TILE (TILE * TILE / LANES)
#define BLOCKS_X (TILE / BLOCK_W)

// Overwrites counts [tiles, BLOCKS_PER_TILE] with the number of useful pairs in each block of LANES pixels. Global
// size: the number of counts.
kernel void count_pairs(
    global const uint2 *restrict tile_ranges,
    global const uint *restrict lists,
    global const uint *restrict isect_splat,
    global const real *restrict records,
    global uint *restrict counts,
    uint n_counts,
    int width,
    int height,
    int tiles_x
) {
    const uint id = get_global_id(0);
    if (id >= n_counts) return;
    const int tile = id / BLOCKS_PER_TILE, block = id % BLOCKS_PER_TILE;
    const int x = tile % tiles_x * TILE + block % BLOCKS_X * BLOCK_W,
              y = tile / tiles_x * TILE + block / BLOCKS_X * BLOCK_H;
    const uint2 range = tile_ranges[tile];
    const vreal px = (vreal)(x + R(0.5)) + lanes_block_x(), py = (vreal)(y + R(0.5)) + lanes_block_y();
    const vmask inside = (px < (vreal)width) & (py < (vreal)height);
    vreal T = lanes_if(inside, (vreal)1, (vreal)-1), count = (vreal)0;
    for (uint at = range.x; at < range.y && lanes_any(lanes_not(BLEND_DONE(T))); ++at) {
        real rec[RECORD_STRIDE];
        load_record(record_at(records, isect_splat[lists[at]]), rec);
        shape_pixel pixel;
        vreal alpha = shape_alpha(px - rec[HEAD_X], py - rec[HEAD_Y], rec + HEAD, &pixel);
        const vmask live = lanes_not(BLEND_DONE(T));
        vmask hit;
        blend(&alpha, &T, &hit);
        count += lanes_if(live & (hit | BLEND_DONE(T)), (vreal)1, (vreal)0);
    }
    counts[id] = (uint)lanes_sum(count);
}
