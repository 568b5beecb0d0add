// bin.cl: lists of the isects of each tile, for devices with few work-items (CPUs). Each counts a chunk of depth ranks by
// tile, then writes it to the lists.

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
// band's tiles to places in `lists`. CULLS_STRIPS: overwrites isect_blocks, too, with the strips that the splat reaches
// (strips.clh).
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
#if CULLS_STRIPS
    global const real *restrict records,
    global uint *restrict isect_blocks,
#endif
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
#if CULLS_STRIPS
        real rec[RECORD_STRIDE];
        load_record(record_at(records, i), rec);
#endif
        const int end_y = min((int)rect.w, end_row);
        for (int y = max((int)rect.y, first_row); y < end_y; ++y) {
            const int row = y * tiles_x, end_x = min((int)rect.z, end_tile - row);
            for (int x = max((int)rect.x, first_tile - row); x < end_x; ++x, ++at) {
#if CULLS_STRIPS
                isect_blocks[at] = strips_reached(rec, x * TILE, y * TILE);
#endif
                lists[place[row + x]++] = at;
                isect_splat[at] = i;
            }
        }
        splat_isects[i] = (uint2)(first, at);
    }
}
