// sort.cl: a stable radix sort of (key, value) pairs, least significant digit first, and an exclusive scan.
//
// Each pass counts digits, scans the counts and scatters (Zagha and Blelloch 1991). SORT_GROUP work-items share a block of
// the input. Each has a contiguous run of it, so pairs with the same digit keep their order. RADIX = 1 << RADIX_BITS.
// A block has fewer than 65 536 pairs, so its counters have 16 bits: the digits can be wider.

#define RADIX (1 << RADIX_BITS)
#define SORT_ATTRIBUTE __attribute__((reqd_work_group_size(SORT_GROUP, 1, 1)))
#define HELPERS (SORT_GROUP / RADIX)  // work-items that share the counters of a digit
#define SHARE (SORT_GROUP / HELPERS)  // counters of each

// Overwrites hist[digit * SORT_GROUP + item] with the histograms of this group's runs.
static inline void count_digits(global const uint *keys, uint n, uint run, uint shift, local ushort *hist) {
    const uint lid = get_local_id(0);
    for (uint d = 0; d < RADIX; ++d) hist[d * SORT_GROUP + lid] = 0;
    const ulong start = (ulong)get_global_id(0) * run;
    for (ulong k = start; k < start + run && k < n; ++k) ++hist[((keys[k] >> shift) & (RADIX - 1)) * SORT_GROUP + lid];
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Writes to parts [SORT_GROUP] the sum of the counters that each work-item has a share of: helper h of digit d is d * HELPERS
// + h.
static inline void share_sums(local const ushort *hist, local uint *parts) {
    const uint lid = get_local_id(0);
    uint sum = 0;
    for (uint k = 0; k < SHARE; ++k) sum += hist[lid * SHARE + k];
    parts[lid] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Overwrites counts [RADIX, n_blocks], digit-major.
SORT_ATTRIBUTE
kernel void
radix_histogram(global const uint *restrict keys, global uint *restrict counts, uint n, uint run, uint shift) {
    local ushort hist[RADIX * SORT_GROUP];
    local uint parts[SORT_GROUP];
    count_digits(keys, n, run, shift, hist);
    share_sums(hist, parts);
    const uint d = get_local_id(0);
    if (d >= RADIX) return;
    uint sum = 0;
    for (uint h = 0; h < HELPERS; ++h) sum += parts[d * HELPERS + h];
    counts[d * get_num_groups(0) + get_group_id(0)] = sum;
}

// Replaces the counts of each digit by their exclusive scan over the blocks, and overwrites totals [RADIX] with their sums.
// A group for each digit.
SORT_ATTRIBUTE
kernel void radix_scan(global uint *restrict counts, global uint *restrict totals, uint n_blocks) {
    local uint sums[SORT_GROUP];
    const uint lid = get_local_id(0), digit = get_group_id(0);
    global uint *of_digit = counts + (ulong)digit * n_blocks;
    uint before = 0;
    for (uint first = 0; first < n_blocks; first += SORT_GROUP) {
        const uint block = first + lid;
        const uint count = block < n_blocks ? of_digit[block] : 0;
        sums[lid] = count;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint step = 1; step < SORT_GROUP; step *= 2) {  // Hillis and Steele 1986
            const uint other = lid >= step ? sums[lid - step] : 0;
            barrier(CLK_LOCAL_MEM_FENCE);
            sums[lid] += other;
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        if (block < n_blocks) of_digit[block] = before + sums[lid] - count;
        before += sums[SORT_GROUP - 1];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (lid == 0) totals[digit] = before;
}

// Overwrites keys_out and values_out with the pairs by digit. counts and totals: what radix_scan wrote. If `numbered`, the
// value of a pair is its place, and values are not read.
SORT_ATTRIBUTE
kernel void radix_scatter(
    global const uint *restrict keys,
    global const uint *restrict values,
    global const uint *restrict counts,
    global const uint *restrict totals,
    global uint *restrict keys_out,
    global uint *restrict values_out,
    uint n,
    uint run,
    uint shift,
    uint numbered
) {
    local ushort hist[RADIX * SORT_GROUP];
    local uint parts[SORT_GROUP], starts[RADIX];
    const uint lid = get_local_id(0);
    if (lid < RADIX) {
        uint at = counts[lid * get_num_groups(0) + get_group_id(0)];
        for (uint d = 0; d < lid; ++d) at += totals[d];
        starts[lid] = at;
    }
    count_digits(keys, n, run, shift, hist);
    share_sums(hist, parts);
    // Each counter becomes the number of pairs with its digit in the runs before its own.
    uint before = 0;
    for (uint h = lid / HELPERS * HELPERS; h < lid; ++h) before += parts[h];
    for (uint k = 0; k < SHARE; ++k) {
        const uint count = hist[lid * SHARE + k];
        hist[lid * SHARE + k] = (ushort)before;
        before += count;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const ulong start = (ulong)get_global_id(0) * run;
    for (ulong k = start; k < start + run && k < n; ++k) {
        const uint key = keys[k], digit = (key >> shift) & (RADIX - 1);
        const uint to = starts[digit] + hist[digit * SORT_GROUP + lid]++;
        keys_out[to] = key;
        values_out[to] = numbered ? (uint)k : values[k];
    }
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
