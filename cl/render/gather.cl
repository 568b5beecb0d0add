// gather.cl: the gradient of each splat: the sum of the records that rasterize_vjp wrote for its isects.
//
// moments [V_RECORD, capacity]: the sum over each splat's isects, in a fixed order. Overwrites, or adds to the sum if
// `go_on`. Global size: splats / LANES.
//
// With one lane, a splat of many isects would keep a GPU waiting for one work-item: a splat that covers an image has an
// isect in each tile. So all work-items of a group share the splats of the group that have more than MANY_ISECTS. Each item
// adds up every n-th isect, and some items then add up the sums of all.

#define MANY_ISECTS 256

static inline void add_record(global const real *isect_grads, uint isect, real *record) {
    UNROLL for (int j = 0; j < V_RECORD; ++j) record[j] += isect_grads[(ulong)isect * V_RECORD + j];
}

kernel void gather_isect_grads(
    global const uint2 *restrict splat_isects,
    global const real *restrict isect_grads,
    global real *restrict moments,
    ulong capacity,
    uint n_splats,
    int go_on
) {
#if COLUMNS
    local uint2 ranges[GATHER_ITEMS];
    local real sums[V_RECORD * (GATHER_ITEMS + 1)];
    const uint splat = get_global_id(0), item = get_local_id(0), items = get_local_size(0);
    const uint2 range = splat < n_splats ? splat_isects[splat] : (uint2)(0, 0);
    const bool many = range.y - range.x > MANY_ISECTS;
    ranges[item] = range;
    if (splat < n_splats && !many) {
        real record[V_RECORD];
        UNROLL for (int j = 0; j < V_RECORD; ++j) record[j] = go_on ? moments[splat + j * capacity] : 0;
        for (uint isect = range.x; isect < range.y; ++isect) add_record(isect_grads, isect, record);
        UNROLL for (int j = 0; j < V_RECORD; ++j) moments[splat + j * capacity] = record[j];
    }
    if (!group_any(many, sums)) return;  // uniform over the group
    for (uint k = 0; k < items; ++k) {
        const uint2 shared_range = ranges[k];
        if (shared_range.y - shared_range.x <= MANY_ISECTS) continue;  // uniform, too
        real record[V_RECORD];
        UNROLL for (int j = 0; j < V_RECORD; ++j) record[j] = 0;
        for (uint isect = shared_range.x + item; isect < shared_range.y; isect += items)
            add_record(isect_grads, isect, record);
        UNROLL for (int j = 0; j < V_RECORD; ++j) sums[j * (GATHER_ITEMS + 1) + item] = record[j];
        group_barrier();
        for (uint j = item; j < V_RECORD; j += items) {
            global real *moment = moments + (splat - item + k) + j * capacity;
            real sum = go_on ? *moment : 0;
            for (uint other = 0; other < items; ++other) sum += sums[j * (GATHER_ITEMS + 1) + other];
            *moment = sum;
        }
        group_barrier();
    }
#else
    const uint first = get_global_id(0) * LANES;
    if (first >= n_splats) return;
    real sums[V_RECORD][LANES];
    for (uint l = 0; l < LANES; ++l) {
        const uint2 range = first + l < n_splats ? splat_isects[first + l] : (uint2)(0, 0);
        real record[V_RECORD];
        for (int j = 0; j < V_RECORD; ++j) record[j] = go_on ? moments[first + l + j * capacity] : 0;
        for (uint isect = range.x; isect < range.y; ++isect) add_record(isect_grads, isect, record);
        for (int j = 0; j < V_RECORD; ++j) sums[j][l] = record[j];
    }
    for (int j = 0; j < V_RECORD; ++j) lanes_store(lanes_load(sums[j]), moments + first + j * capacity);
#endif
}
