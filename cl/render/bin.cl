// bin.cl: which splat touches which tile. A (splat, tile) pair is an isect.
//
// Splats come in depth order, so a list of isects by tile that keeps their order is front to back. A splat's isects are
// contiguous in the unsorted numbering, row by row: its gradient is a plain ordered sum over them. A *band* is a range
// of tiles in row-major order: all of them, unless the isects of an image are too many for one buffer.

// First and past-the-end row that the band has tiles in.
static inline int first_row_of(int first_tile, int tiles_x) { return first_tile / tiles_x; }
static inline int past_row_of(int past_tile, int tiles_x) { return (past_tile + tiles_x - 1) / tiles_x; }

// ---- Groups: a work-item a splat, and a sort by tile (sort.cl).

// counts [n]: the band's tiles of the splat at each depth rank. Overwrites.
kernel void count_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global uint *restrict counts,
    uint n_splats,
    int first_tile,
    int past_tile,
    int tiles_x
) {
    const uint rank = get_global_id(0);
    if (rank >= n_splats) return;
    const int4 rect = tile_rect[order[rank]];
    const int past_y = min(rect.w, past_row_of(past_tile, tiles_x));
    uint count = 0;
    for (int y = max(rect.y, first_row_of(first_tile, tiles_x)); y < past_y; ++y) {
        const int row = y * tiles_x;
        count += (uint)max(min(rect.z, past_tile - row) - max(rect.x, first_tile - row), 0);
    }
    counts[rank] = count;
}

// offsets [n]: exclusive scan of counts. splat_isects [n]: first isect and past-the-end, by splat.
// isect_tile, isect_id, isect_splat [n_isects]: sort key, unsorted number (the sort's payload), splat.
kernel void emit_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global const uint *restrict offsets,
    global uint2 *restrict splat_isects,
    global uint *restrict isect_tile,
    global uint *restrict isect_id,
    global uint *restrict isect_splat,
    uint n_splats,
    int first_tile,
    int past_tile,
    int tiles_x
) {
    const uint rank = get_global_id(0);
    if (rank >= n_splats) return;
    const uint i = order[rank];
    const int4 rect = tile_rect[i];
    const int past_y = min(rect.w, past_row_of(past_tile, tiles_x));
    uint at = offsets[rank];
    const uint start = at;
    for (int y = max(rect.y, first_row_of(first_tile, tiles_x)); y < past_y; ++y) {
        const int row = y * tiles_x, past_x = min(rect.z, past_tile - row);
        for (int x = max(rect.x, first_tile - row); x < past_x; ++x, ++at) {
            isect_tile[at] = (uint)(row + x);
            isect_id[at] = at;
            isect_splat[at] = i;
        }
    }
    splat_isects[i] = (uint2)(start, at);
}

// tile_ranges [n_tiles]: first and past-the-end position of each tile in the sorted isects. Must be zero before.
kernel void
find_tile_ranges(global const uint *restrict sorted_tile, global uint *restrict tile_ranges, uint n_isects) {
    const uint at = get_global_id(0);
    if (at >= n_isects) return;
    const uint tile = sorted_tile[at];
    if (at == 0 || sorted_tile[at - 1] != tile) tile_ranges[2 * tile] = at;
    if (at + 1 == n_isects || sorted_tile[at + 1] != tile) tile_ranges[2 * tile + 1] = at + 1;
}

// ---- Few work-items (CPUs): a chunk of depth ranks each, counted by tile and then written straight to the lists.

// counts [chunks, (tiles_x + 1) (tiles_y + 1)]: splats of the chunk over each tile, in the first tiles_x tiles_y places.
// n_visible [1]. ranked_rect [n_visible]: rectangles by depth rank. Overwrites. Takes as long for large splats as for
// small ones: a rectangle is four corners of which sums along x and y make its inside.
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
    global int *own = counts + chunk * cells;
    for (int k = 0; k < cells; ++k) own[k] = 0;
    for (uint rank = start; rank < end; ++rank) {
        const int4 rect = tile_rect[order[rank]];
        ranked_rect[rank] = (ushort4)((ushort)rect.x, (ushort)rect.y, (ushort)rect.z, (ushort)rect.w);
    }
    for (uint rank = start; rank < end; ++rank) {
        const ushort4 rect = ranked_rect[rank];
        global int *top = own + rect.y * stride, *bottom = own + rect.w * stride;
        ++top[rect.x];
        --top[rect.z];
        --bottom[rect.x];
        ++bottom[rect.z];
    }
    for (int y = 0; y < tiles_y; ++y) {  // in place: what is written lies before what is yet to be read
        int along_row = 0;
        for (int x = 0; x < tiles_x; ++x) {
            along_row += own[y * stride + x];
            own[y * tiles_x + x] = along_row + (y > 0 ? own[(y - 1) * tiles_x + x] : 0);
        }
    }
}

// totals [n_tiles]: isects of each tile. counts: those of the chunks before. Each work-item has `run` tiles.
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
        global uint *own = counts + (ulong)chunk * cells;
        for (uint tile = start; tile < end; ++tile) {
            const uint count = own[tile];
            own[tile] = totals[tile];
            totals[tile] += count;
        }
    }
}

// As emit_isects, find_tile_ranges and a sort by tile: lists [n_isects], unsorted numbers by tile, front to back. Only the
// band's tile_ranges are written. counts of the band's tiles become the places in `lists`.
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
    int past_tile,
    int tiles_x
) {
    const ulong chunk = get_global_id(0), chunks = get_global_size(0), n = n_visible[0];
    const uint start = (uint)(chunk * n / chunks), end = (uint)((chunk + 1) * n / chunks);
    global uint *place = counts + chunk * cells;
    uint at = 0, tile_start = 0;  // isects of the chunks before; of the tiles before
    for (int tile = first_tile; tile < past_tile; ++tile) {
        at += place[tile];
        place[tile] += tile_start;
        const uint2 range = (uint2)(tile_start, tile_start + totals[tile]);
        if (chunk == 0) tile_ranges[tile] = range;
        tile_start = range.y;
    }
    const int first_row = first_row_of(first_tile, tiles_x), past_row = past_row_of(past_tile, tiles_x);
    for (uint rank = start; rank < end; ++rank) {
        const uint i = order[rank], first = at;
        const ushort4 rect = ranked_rect[rank];
        const int past_y = min((int)rect.w, past_row);
        for (int y = max((int)rect.y, first_row); y < past_y; ++y) {
            const int row = y * tiles_x, past_x = min((int)rect.z, past_tile - row);
            for (int x = max((int)rect.x, first_tile - row); x < past_x; ++x, ++at) {
                lists[place[row + x]++] = at;
                isect_splat[at] = i;
            }
        }
        splat_isects[i] = (uint2)(first, at);
    }
}
