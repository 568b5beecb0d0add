// bin.cl: lists of the isects of each tile. An isect is a pair of a splat and a tile that its box meets.
//
// Splats come in depth order. A list of isects by tile that keeps this order is from front to back. The isects of a splat
// have consecutive numbers, row by row of tiles, so its gradient is an ordered sum over them. A band is a range of tiles in
// row-major order: all tiles, unless the isects of an image are too many for one buffer.

// First row with tiles of the band, and the row after the last one.
static inline int first_row_of(int first_tile, int tiles_x) { return first_tile / tiles_x; }
static inline int end_row_of(int end_tile, int tiles_x) { return (end_tile + tiles_x - 1) / tiles_x; }

// ---- Devices with many work-items: one for each splat, then a sort by tile (sort.cl).

// Overwrites counts [n]: the number of tiles of the band that the splat at each depth rank meets.
kernel void count_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global uint *restrict counts,
    uint n_splats,
    int first_tile,
    int end_tile,
    int tiles_x
) {
    const uint rank = get_global_id(0);
    if (rank >= n_splats) return;
    const int4 rect = tile_rect[order[rank]];
    const int end_y = min(rect.w, end_row_of(end_tile, tiles_x));
    uint count = 0;
    for (int y = max(rect.y, first_row_of(first_tile, tiles_x)); y < end_y; ++y) {
        const int row = y * tiles_x;
        count += (uint)max(min(rect.z, end_tile - row) - max(rect.x, first_tile - row), 0);
    }
    counts[rank] = count;
}

// Overwrites splat_isects [n], by splat, with the first isect and the end; and for each isect [n_isects] isect_tile, the key
// of the sort, and isect_splat. offsets [n]: exclusive scan of counts.
kernel void emit_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global const uint *restrict offsets,
    global uint2 *restrict splat_isects,
    global uint *restrict isect_tile,
    global uint *restrict isect_splat,
    uint n_splats,
    int first_tile,
    int end_tile,
    int tiles_x
) {
    const uint rank = get_global_id(0);
    if (rank >= n_splats) return;
    const uint i = order[rank];
    const int4 rect = tile_rect[i];
    const int end_y = min(rect.w, end_row_of(end_tile, tiles_x));
    uint at = offsets[rank];
    const uint start = at;
    for (int y = max(rect.y, first_row_of(first_tile, tiles_x)); y < end_y; ++y) {
        const int row = y * tiles_x, end_x = min(rect.z, end_tile - row);
        for (int x = max(rect.x, first_tile - row); x < end_x; ++x, ++at) {
            isect_tile[at] = (uint)(row + x);
            isect_splat[at] = i;
        }
    }
    splat_isects[i] = (uint2)(start, at);
}

// Writes tile_ranges [n_tiles]: first position and end of each tile with isects in the sorted list. It must be zero before.
kernel void
find_tile_ranges(global const uint *restrict sorted_tile, global uint *restrict tile_ranges, uint n_isects) {
    const uint at = get_global_id(0);
    if (at >= n_isects) return;
    const uint tile = sorted_tile[at];
    if (at == 0 || sorted_tile[at - 1] != tile) tile_ranges[2 * tile] = at;
    if (at + 1 == n_isects || sorted_tile[at + 1] != tile) tile_ranges[2 * tile + 1] = at + 1;
}

// ---- Devices with few work-items (CPUs): each counts a chunk of depth ranks by tile, then writes it to the lists.

// Overwrites ranked_rect [n_visible] with the rectangles by depth rank. Overwrites counts [chunks, (tiles_x + 1) (tiles_y + 1)]
// with the splats of the chunk over each tile, in the first tiles_x tiles_y places. A rectangle adds to its four corners only, and
// sums along x and y fill its inside (Crow 1984, summed-area tables): so large splats take no longer than small ones.
kernel void count_tiles(
    global const uint *restrict order,
    global const uint *restrict n_visible,
    global const int4 *restrict tile_rect,
    global ushort4 *restrict ranked_rect,
    global int *restrict counts,
    int tiles_x,
    int tiles_y
) {
    const ulong chunk = get_global_id(0), chunks = get_global_size(0), n = n_visible[0];
    const uint start = (uint)(chunk * n / chunks), end = (uint)((chunk + 1) * n / chunks);
    const int stride = tiles_x + 1, cells = stride * (tiles_y + 1);
    global int *count = counts + chunk * cells;
    for (int k = 0; k < cells; ++k) count[k] = 0;
    for (uint rank = start; rank < end; ++rank) {
        const int4 rect = tile_rect[order[rank]];
        ranked_rect[rank] = (ushort4)((ushort)rect.x, (ushort)rect.y, (ushort)rect.z, (ushort)rect.w);
    }
    for (uint rank = start; rank < end; ++rank) {
        const ushort4 rect = ranked_rect[rank];
        global int *top = count + rect.y * stride, *bottom = count + rect.w * stride;
        ++top[rect.x];
        --top[rect.z];
        --bottom[rect.x];
        ++bottom[rect.z];
    }
    for (int y = 0; y < tiles_y; ++y) {  // in place: each write is before the places that are still to be read
        int along_row = 0;
        for (int x = 0; x < tiles_x; ++x) {
            along_row += count[y * stride + x];
            count[y * tiles_x + x] = along_row + (y > 0 ? count[(y - 1) * tiles_x + x] : 0);
        }
    }
}

// Overwrites totals [n_tiles] with the isects of each tile, and counts with those of the chunks before. A work-item has
// `run` tiles.
kernel void total_tiles(
    global uint *restrict counts,
    global uint *restrict totals,
    uint n_chunks,
    uint cells,
    uint n_tiles,
    uint run
) {
    const uint start = get_global_id(0) * run, end = min(start + run, n_tiles);
    for (uint tile = start; tile < end; ++tile) totals[tile] = 0;
    for (uint chunk = 0; chunk < n_chunks; ++chunk) {
        global uint *of_chunk = counts + (ulong)chunk * cells;
        for (uint tile = start; tile < end; ++tile) {
            const uint count = of_chunk[tile];
            of_chunk[tile] = totals[tile];
            totals[tile] += count;
        }
    }
}

// Overwrites lists [n_isects], the numbers of the isects by tile from front to back, splat_isects, isect_splat and the
// tile_ranges of the band: the result of emit_isects, a sort by tile and find_tile_ranges. It changes the counts of the
// band's tiles to places in `lists`.
kernel void list_isects(
    global const uint *restrict order,
    global const uint *restrict n_visible,
    global const ushort4 *restrict ranked_rect,
    global const uint *restrict totals,
    global uint *restrict counts,
    global uint2 *restrict tile_ranges,
    global uint2 *restrict splat_isects,
    global uint *restrict isect_splat,
    global uint *restrict lists,
    uint cells,
    int first_tile,
    int end_tile,
    int tiles_x
) {
    const ulong chunk = get_global_id(0), chunks = get_global_size(0), n = n_visible[0];
    const uint start = (uint)(chunk * n / chunks), end = (uint)((chunk + 1) * n / chunks);
    global uint *place = counts + chunk * cells;
    uint at = 0, tile_start = 0;  // isects of the chunks before, and of the tiles before
    for (int tile = first_tile; tile < end_tile; ++tile) {
        at += place[tile];
        place[tile] += tile_start;
        const uint2 range = (uint2)(tile_start, tile_start + totals[tile]);
        if (chunk == 0) tile_ranges[tile] = range;
        tile_start = range.y;
    }
    const int first_row = first_row_of(first_tile, tiles_x), end_row = end_row_of(end_tile, tiles_x);
    for (uint rank = start; rank < end; ++rank) {
        const uint i = order[rank], first = at;
        const ushort4 rect = ranked_rect[rank];
        const int end_y = min((int)rect.w, end_row);
        for (int y = max((int)rect.y, first_row); y < end_y; ++y) {
            const int row = y * tiles_x, end_x = min((int)rect.z, end_tile - row);
            for (int x = max((int)rect.x, first_tile - row); x < end_x; ++x, ++at) {
                lists[place[row + x]++] = at;
                isect_splat[at] = i;
            }
        }
        splat_isects[i] = (uint2)(first, at);
    }
}
