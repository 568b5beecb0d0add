// sort.cl: a stable radix sort of (key, value) pairs, least significant digit first, and the exclusive scan that it needs.
//
// Each pass counts digits, scans the counts and scatters (Zagha and Blelloch 1991). SORT_GROUP work-items share a block of
// the input. Each has a contiguous run of it, so pairs with the same digit keep their order. RADIX = 1 << RADIX_BITS.

#define RADIX (1 << RADIX_BITS)
#define SORT_ATTRIBUTE __attribute__((reqd_work_group_size(SORT_GROUP, 1, 1)))

// Overwrites hist[digit * SORT_GROUP + item] with the histograms of this group's runs.
static inline void count_digits(global const uint *keys, uint n, uint run, uint shift, local uint *hist) {
    const uint lid = get_local_id(0);
    for (uint d = 0; d < RADIX; ++d) hist[d * SORT_GROUP + lid] = 0;
    const ulong start = (ulong)get_global_id(0) * run;
    for (ulong k = start; k < start + run && k < n; ++k) ++hist[((keys[k] >> shift) & (RADIX - 1)) * SORT_GROUP + lid];
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Overwrites counts [RADIX, n_blocks], digit-major. Its exclusive scan is the place where each digit of each block starts.
SORT_ATTRIBUTE
kernel void
radix_histogram(global const uint *restrict keys, global uint *restrict counts, uint n, uint run, uint shift) {
    local uint hist[RADIX * SORT_GROUP];
    count_digits(keys, n, run, shift, hist);
    for (uint d = get_local_id(0); d < RADIX; d += SORT_GROUP) {
        uint sum = 0;
        for (uint item = 0; item < SORT_GROUP; ++item) sum += hist[d * SORT_GROUP + item];
        counts[d * get_num_groups(0) + get_group_id(0)] = sum;
    }
}

// Overwrites keys_out and values_out with the pairs by digit. starts: the scanned counts.
SORT_ATTRIBUTE
kernel void radix_scatter(
    global const uint *restrict keys,
    global const uint *restrict values,
    global const uint *restrict starts,
    global uint *restrict keys_out,
    global uint *restrict values_out,
    uint n,
    uint run,
    uint shift
) {
    local uint hist[RADIX * SORT_GROUP];
    count_digits(keys, n, run, shift, hist);
    for (uint d = get_local_id(0); d < RADIX; d += SORT_GROUP) {
        uint at = starts[d * get_num_groups(0) + get_group_id(0)];
        for (uint item = 0; item < SORT_GROUP; ++item) {
            const uint count = hist[d * SORT_GROUP + item];
            hist[d * SORT_GROUP + item] = at;
            at += count;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint lid = get_local_id(0);
    const ulong start = (ulong)get_global_id(0) * run;
    for (ulong k = start; k < start + run && k < n; ++k) {
        const uint key = keys[k];
        const uint to = hist[((key >> shift) & (RADIX - 1)) * SORT_GROUP + lid]++;
        keys_out[to] = key;
        values_out[to] = values[k];
    }
}

kernel void fill_iota(global uint *restrict values, uint n) {
    const uint i = get_global_id(0);
    if (i < n) values[i] = i;
}

// The exclusive scan has three steps (Blelloch 1990): a work-item sums each run, one group scans the sums, and a work-item
// scans each run. This is the first step.
kernel void scan_sums(global const uint *restrict values, global ulong *restrict sums, uint n, uint run) {
    const ulong start = (ulong)get_global_id(0) * run;
    ulong sum = 0;
    for (ulong k = start; k < start + run && k < n; ++k) sum += values[k];
    sums[get_global_id(0)] = sum;
}

// Replaces sums by its exclusive scan, and writes the sum of all to total[0]. One group.
SORT_ATTRIBUTE
kernel void scan_spine(global ulong *restrict sums, global ulong *restrict total, uint n) {
    local ulong part[SORT_GROUP];
    const uint lid = get_local_id(0);
    const uint run = (n + SORT_GROUP - 1) / SORT_GROUP;
    const uint start = min(lid * run, n), end = min(start + run, n);
    ulong sum = 0;
    for (uint k = start; k < end; ++k) sum += sums[k];
    part[lid] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lid == 0) {
        ulong at = 0;
        for (uint item = 0; item < SORT_GROUP; ++item) {
            const ulong count = part[item];
            part[item] = at;
            at += count;
        }
        total[0] = at;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    ulong at = part[lid];
    for (uint k = start; k < end; ++k) {
        const ulong count = sums[k];
        sums[k] = at;
        at += count;
    }
}

// Overwrites scanned, modulo 2^32. It must not be the buffer of values.
kernel void scan_apply(
    global const uint *restrict values,
    global const ulong *restrict sums,
    global uint *restrict scanned,
    uint n,
    uint run
) {
    const ulong start = (ulong)get_global_id(0) * run;
    uint at = (uint)sums[get_global_id(0)];
    for (ulong k = start; k < start + run && k < n; ++k) {
        scanned[k] = at;
        at += values[k];
    }
}
