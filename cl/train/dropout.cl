// dropout.cl: hides some projected splats for one iteration (clsplat/training/dropout.py).

// Overwrites depth_key [n] and tile_rect [n] of some splats, as project_splats does for splats that the image does not show.
// Those are the splats whose random word is below `below`. The word depends on seed, iteration and splat only. Global size: at
// least n.
kernel void drop_splats(
    global uint *restrict depth_key,
    global int4 *restrict tile_rect,
    uint n,
    uint seed_lo,
    uint seed_hi,
    uint iteration,
    uint below
) {
    const uint i = get_global_id(0);
    if (i >= n) return;
    vuint words[4] = {i, iteration, DROPOUT_STREAM, 0};
    philox(words, (uint2)(seed_lo, seed_hi));
    if (words[0] >= below) return;
    depth_key[i] = CULLED_KEY;
    tile_rect[i] = (int4)(0, 0, 0, 0);
}
