// group_bin.cl: isects by splat, for devices with many work-items, and the range of each tile after a sort by tile (sort.cl).
//
// A work-item counts the isects of a depth rank, and a group scans the counts of its block of ranks. One group scans the
// sums of all blocks. Then a work-item lists one isect: if it listed those of a splat, everything would wait for the splats
// that cover the image.

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

// Overwrites block_counts [groups] with the isects of the band in each block of depth ranks. Overwrites rank_starts [n], by
// rank, with those of its block before the rank, and splat_isects [n] with empty ranges.
SCAN_ATTRIBUTE
kernel void count_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global uint *restrict block_counts,
    global uint *restrict rank_starts,
    global uint2 *restrict splat_isects,
    uint n_splats,
    int first_tile,
    int end_tile,
    int tiles_x
) {
    local ulong sums[SCAN_GROUP];
    const uint rank = get_global_id(0), i = rank < n_splats ? order[rank] : 0;
    const int4 rect = rank < n_splats ? tile_rect[i] : (int4)(0, 0, 0, 0);
    const uint before = (uint)scan_group(tiles_in_band(rect, first_tile, end_tile, tiles_x), sums);
    if (get_local_id(0) == 0) block_counts[get_group_id(0)] = (uint)sums[SCAN_GROUP - 1];
    if (rank >= n_splats) return;
    rank_starts[rank] = before;
    splat_isects[i] = (uint2)(0, 0);
}

// Replaces block_counts [n_blocks] by their exclusive scan, modulo 2^32, and writes their sum to total[0]. One group.
SCAN_ATTRIBUTE
kernel void scan_isects(global uint *restrict block_counts, global ulong *restrict total, uint n_blocks) {
    local ulong sums[SCAN_GROUP];
    const ulong sum = scan_blocks(block_counts, n_blocks, sums);
    if (get_local_id(0) == 0) total[0] = sum;
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

// The tile of isect `k` of a splat: tiles of its rectangle row by row. The band cuts the first row, and the last one.
static inline int tile_of_isect(int4 rect, uint k, int first_tile, int tiles_x) {
    const int y = max(rect.y, first_row_of(first_tile, tiles_x)), skipped = max(first_tile - y * tiles_x - rect.x, 0);
    const int width = rect.z - rect.x, place = (int)k + min(skipped, width);
    return (y + place / width) * tiles_x + rect.x + place % width;
}

// Overwrites for each isect [n_isects] isect_tile, the key of the sort, and isect_splat. CULLS_STRIPS: isect_blocks, too, with
// the strips that the splat reaches (strips.clh). Overwrites splat_isects of splats with isects: the first one and the end.
// block_starts [n_blocks] and rank_starts: what scan_isects and count_isects wrote.
kernel void emit_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global const uint *restrict block_starts,
    global const uint *restrict rank_starts,
    global uint2 *restrict splat_isects,
    global uint *restrict isect_tile,
    global uint *restrict isect_splat,
#if CULLS_STRIPS
    global const real *restrict records,
    global uint *restrict isect_blocks,
#endif
    uint n_splats,
    uint n_blocks,
    uint n_isects,
    int first_tile,
    int end_tile,
    int tiles_x
) {
    const uint isect = get_global_id(0);
    if (isect >= n_isects) return;
    // The last block, and in it the last rank, that starts at this isect or before.
    const uint block = first_not_below(block_starts, n_blocks, isect + 1) - 1;
    const uint first_rank = block * SCAN_GROUP, in_block = isect - block_starts[block];
    const uint ranks = min(n_splats - first_rank, (uint)SCAN_GROUP);
    const uint rank = first_rank + first_not_below(rank_starts + first_rank, ranks, in_block + 1) - 1;
    const uint i = order[rank], k = in_block - rank_starts[rank];
    const int4 rect = tile_rect[i];
    const int tile = tile_of_isect(rect, k, first_tile, tiles_x);
    isect_tile[isect] = (uint)tile;
    isect_splat[isect] = i;
    if (k == 0) splat_isects[i] = (uint2)(isect, isect + tiles_in_band(rect, first_tile, end_tile, tiles_x));
#if CULLS_STRIPS
    real rec[RECORD_STRIDE];
    load_record(record_at(records, i), rec);
    isect_blocks[isect] = strips_reached(rec, tile % tiles_x * TILE, tile / tiles_x * TILE);
#endif
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
