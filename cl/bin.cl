// bin.cl: which splat touches which tile. A (splat, tile) pair is an isect.
//
// Splats come in depth order, so a stable sort of the isects by tile leaves every tile's list in depth order.
// A splat's isects are contiguous in the unsorted numbering: its gradient is a plain ordered sum over them.

// counts [n]: tiles of the splat at each depth rank. Overwrites.
kernel void count_isects(
    global const uint *restrict order,
    global const int4 *restrict tile_rect,
    global uint *restrict counts,
    uint n_splats)
{
    const uint rank = get_global_id(0);
    if (rank >= n_splats) return;
    const int4 rect = tile_rect[order[rank]];
    counts[rank] = (uint)((rect.z - rect.x) * (rect.w - rect.y));
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
    int tiles_x)
{
    const uint rank = get_global_id(0);
    if (rank >= n_splats) return;
    const uint i = order[rank];
    const int4 rect = tile_rect[i];
    uint at = offsets[rank];
    const uint start = at;
    for (int y = rect.y; y < rect.w; ++y)
        for (int x = rect.x; x < rect.z; ++x, ++at) {
            isect_tile[at] = (uint)(y * tiles_x + x);
            isect_id[at] = at;
            isect_splat[at] = i;
        }
    splat_isects[i] = (uint2)(start, at);
}

// tile_ranges [n_tiles]: first and past-the-end position of each tile in the sorted isects. Must be zero before.
kernel void find_tile_ranges(
    global const uint *restrict sorted_tile,
    global uint *restrict tile_ranges,
    uint n_isects)
{
    const uint at = get_global_id(0);
    if (at >= n_isects) return;
    const uint tile = sorted_tile[at];
    if (at == 0 || sorted_tile[at - 1] != tile) tile_ranges[2 * tile] = at;
    if (at + 1 == n_isects || sorted_tile[at + 1] != tile) tile_ranges[2 * tile + 1] = at + 1;
}
