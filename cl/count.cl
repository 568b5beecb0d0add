// count.cl: how much of a frame's work is useful. Not part of rendering: benchmarks compare with it.
//
// A pair of splat and pixel is useful if |alpha| reaches the cutoff and the pixel is not yet finished by a splat before
// it; the one that finishes it counts, as it had to be evaluated. Screen records as in project.cl.

#define RUNS_PER_TILE (TILE * TILE / LANES)

// counts [tiles, RUNS_PER_TILE]: useful pairs of each run of LANES pixels. Overwrites. Global size: the counts.
kernel void count_pairs(
    global const uint2 *restrict tile_ranges,
    global const uint *restrict lists,
    global const uint *restrict isect_splat,
    global const real *restrict records,
    global uint *restrict counts,
    uint n_counts,
    int width,
    int height,
    int tiles_x)
{
    const uint id = get_global_id(0);
    if (id >= n_counts) return;
    const int tile = id / RUNS_PER_TILE, run = id % RUNS_PER_TILE;
    const int x = tile % tiles_x * TILE + run * LANES % TILE, y = tile / tiles_x * TILE + run * LANES / TILE;
    const uint2 range = tile_ranges[tile];
    const vmask inside = ((vreal)x + lanes_iota() < (vreal)width) & lanes_mask(y < height);
    vreal T = lanes_if(inside, (vreal)1, (vreal)-1), count = (vreal)0;
    for (uint at = range.x; at < range.y && lanes_any(lanes_not(BLEND_DONE(T))); ++at) {
        global const real *from = records + (ulong)isect_splat[lists[at]] * RECORD;
        real rec[RECORD];
        for (int j = 0; j < RECORD; ++j) rec[j] = from[j];
        const vreal dx = (vreal)(x + R(0.5) - rec[0]) + lanes_iota();
        shape_pixel pixel;
        vreal alpha = shape_alpha(dx, y + R(0.5) - rec[1], rec + 8, &pixel);
        const vmask live = lanes_not(BLEND_DONE(T));
        vmask hit;
        blend(&alpha, &T, &hit);
        count += lanes_if(live & (hit | BLEND_DONE(T)), (vreal)1, (vreal)0);
    }
    counts[id] = (uint)lanes_sum(count);
}
