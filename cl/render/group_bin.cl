// group_bin.cl: isects by splat, for devices with many work-items, and the range of each tile after a sort by tile (sort.cl).
//
// A work-item has a depth rank. A group counts the isects of its ranks; one group scans the counts of all groups; then each
// group scans the counts of its items and writes their isects.

// Tiles of the band that a rectangle of tiles meets.
static inline uint tiles_in_band(int4 rect, int first_tile, int end_tile, int tiles_x) {
    const int end_y = min(rect.w, end_row_of(end_tile, tiles_x));
    uint count = 0;
    for (int y = max(rect.y, first_row_of(first_tile, tiles_x)); y < end_y; ++y) {
        const int row = y * tiles_x;
        count += (uint)max(min(rect.z, end_tile - row) - max(rect.x, first_tile - row), 0);
    }
    return count;
}

// Overwrites block_counts [groups]: the isects of the band in each group's depth ranks.
SCAN_ATTRIBUTE
kernel void count_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global uint *restrict block_counts,
    uint n_splats,
    int first_tile,
    int end_tile,
    int tiles_x
) {
    local ulong sums[SCAN_GROUP];
    const uint rank = get_global_id(0);
    const int4 rect = rank < n_splats ? tile_rect[order[rank]] : (int4)(0, 0, 0, 0);
    scan_group(tiles_in_band(rect, first_tile, end_tile, tiles_x), sums);
    if (get_local_id(0) == 0) block_counts[get_group_id(0)] = (uint)sums[SCAN_GROUP - 1];
}

// Replaces block_counts [n_blocks] by their exclusive scan, modulo 2^32, and writes their sum to total[0]. One group.
SCAN_ATTRIBUTE
kernel void scan_isects(global uint *restrict block_counts, global ulong *restrict total, uint n_blocks) {
    local ulong sums[SCAN_GROUP];
    const ulong sum = scan_blocks(block_counts, n_blocks, sums);
    if (get_local_id(0) == 0) total[0] = sum;
}

// Overwrites splat_isects [n], by splat, with the first isect and the end; and for each isect [n_isects] isect_tile, the key
// of the sort, and isect_splat. CULLS_STRIPS: isect_blocks, too, with the strips that the splat reaches (strips.clh).
// block_starts [groups]: what scan_isects wrote.
SCAN_ATTRIBUTE
kernel void emit_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global const uint *restrict block_starts,
    global uint2 *restrict splat_isects,
    global uint *restrict isect_tile,
    global uint *restrict isect_splat,
#if CULLS_STRIPS
    global const real *restrict records,
    global uint *restrict isect_blocks,
#endif
    uint n_splats,
    int first_tile,
    int end_tile,
    int tiles_x
) {
    local ulong sums[SCAN_GROUP];
    const uint rank = get_global_id(0), i = rank < n_splats ? order[rank] : 0;
    const int4 rect = rank < n_splats ? tile_rect[i] : (int4)(0, 0, 0, 0);
    const uint before = (uint)scan_group(tiles_in_band(rect, first_tile, end_tile, tiles_x), sums);
    if (rank >= n_splats) return;
    const uint start = block_starts[get_group_id(0)] + before;
    uint at = start;
#if CULLS_STRIPS
    real rec[RECORD_STRIDE];
    load_record(record_at(records, i), rec);
#endif
    const int end_y = min(rect.w, end_row_of(end_tile, tiles_x));
    for (int y = max(rect.y, first_row_of(first_tile, tiles_x)); y < end_y; ++y) {
        const int row = y * tiles_x, end_x = min(rect.z, end_tile - row);
        for (int x = max(rect.x, first_tile - row); x < end_x; ++x, ++at) {
#if CULLS_STRIPS
            isect_blocks[at] = strips_reached(rec, x * TILE, y * TILE);
#endif
            isect_tile[at] = (uint)(row + x);
            isect_splat[at] = i;
        }
    }
    splat_isects[i] = (uint2)(start, at);
}

// The first of n sorted values that is not below `value`, or n.
static inline uint first_not_below(global const uint *sorted, uint n, uint value) {
    uint low = 0, high = n;
    while (low < high) {
        const uint middle = low + (high - low) / 2;
        if (sorted[middle] < value) low = middle + 1;
        else high = middle;
    }
    return low;
}

// Overwrites tile_ranges [n_tiles]: first position and end of each tile in the sorted list; equal for tiles without isects.
kernel void find_tile_ranges(
    global const uint *restrict sorted_tile,
    global uint2 *restrict tile_ranges,
    uint n_isects,
    uint n_tiles
) {
    const uint tile = get_global_id(0);
    if (tile >= n_tiles) return;
    const uint start = first_not_below(sorted_tile, n_isects, tile);
    tile_ranges[tile] = (uint2)(start, first_not_below(sorted_tile, n_isects, tile + 1));
}
