// project.cl: the projection of splats to screen records, and its gradient. A work-item has LANES splats.
//
// geom, sh: component-major parameter buffers [rows, capacity] (clsplat/splats/fields.py). ROW_<FIELD> is the first row of a
// field in geom. The screen record of splat i (record.clh) has HEAD slots, which
// clsplat/rendering/build.py lists, and the shape's SHAPE_N slots. Splats that the image does not show have CULLED_KEY.

// The build fails here if a shape file and its descriptor in clsplat/splats/shapes.py disagree.
typedef char record_has_SHAPE_N_slots[P_COUNT == SHAPE_N ? 1 : -1];
typedef char there_are_SHAPE_V_moments[V_COUNT == SHAPE_V ? 1 : -1];

#define COV2D_MAX R(1e12)  // px^2: the computation would overflow float32 for a wider splat

// Terms that the projection and its gradient share.
typedef struct {
    vec3 mean, c;  // projected point: in the world, in camera axes
    vec3 centre;   // projected point less (x, y, z), in the splat's unit frame; only with SHAPE_CENTRE
    unit_quat quat;
    mat3 rotation;  // of the splat
    vec3 scale;
    projection to_px;
    vec3 a0, a1;            // rows of A = J W [px per world unit]
    vec3 ar0, ar1;          // rows of A R
    vec3 b0, b1;            // rows of B = A R S
    sym2 cov2d;             // B B' + low-pass [px^2]
    splat_params s, shown;  // as stored, and lowered if ANTIALIASED
#if ANTIALIASED
    lowering low;
#endif
    vmask in_front;
} splat_terms;

static inline void load_params(global const real *geom, const ulong capacity, splat_params *s) {
    s->opacity = opacity_of(lanes_load(geom + ROW_OPACITY_LOGIT * capacity));
    s->height = (vreal)1;
    UNROLL for (int row = 0; row < SHAPE_ROWS; ++row) s->raw[row] =
        lanes_load(geom + (SHAPE_FIRST_ROW + row) * capacity);
}

static inline splat_terms splat_project(global const real *geom, const ulong capacity, constant camera *cam) {
    splat_terms s;
    load_params(geom, capacity, &s.s);
    s.quat = quat_load(geom + ROW_QUAT * capacity, capacity);
    s.rotation = quat_rotation(s.quat);
    const vec3 log_scale = vec3_load(geom + ROW_LOG_SCALE * capacity, capacity);
    s.scale = (vec3){exp(log_scale.x), exp(log_scale.y), exp(log_scale.z)};
    s.mean = vec3_load(geom + ROW_MEAN * capacity, capacity);
#ifdef SHAPE_CENTRE
    s.centre = shape_centre(s.s);
    s.mean = add3(s.mean, mat3_apply(s.rotation, mul3(s.scale, s.centre)));
#endif
    s.c = camera_from_world(cam, s.mean);
    s.in_front = s.c.z >= (vreal)cam->near;
    s.c.z = lanes_if(s.in_front, s.c.z, (vreal)1);
    s.to_px = camera_project(cam, s.c);
    const mat3 w = camera_rotation(cam);
    s.a0 = add3(scale3(w.r0, s.to_px.j00), scale3(w.r2, s.to_px.j02));
    s.a1 = add3(scale3(w.r1, s.to_px.j11), scale3(w.r2, s.to_px.j12));
    s.ar0 = mat3_apply_transposed(s.rotation, s.a0);
    s.ar1 = mat3_apply_transposed(s.rotation, s.a1);
    s.b0 = mul3(s.ar0, s.scale);
    s.b1 = mul3(s.ar1, s.scale);
    s.cov2d = cov2d_of(s.b0, s.b1);
    s.shown = s.s;
#if ANTIALIASED
    s.low = lowered(s.s, s.b0, s.b1);
    s.shown.opacity *= s.low.factor;
    s.shown.height = s.low.factor;
#endif
    return s;
}

static inline vec3 unit_direction(constant camera *cam, vec3 mean, vreal *inv_norm) {
    const vec3 from = add3(mean, scale3(camera_position(cam), (vreal)-1));
    *inv_norm = (vreal)1 / sqrt(max(dot3(from, from), (vreal)R(1e-30)));
    return scale3(from, *inv_norm);
}

// Overwrites depth_key [n], which grows with depth, or is CULLED_KEY for a splat that is not seen. Overwrites tile_rect [n]: x
// and y of the first tile, then of the tile past the end. Overwrites records [n, RECORD_STRIDE], but leaves alone those of a vector
// of splats without a seen one. Global size: splats / LANES.
kernel void project_splats(
    global const real *restrict geom,
    global const real *restrict sh,
    constant camera *restrict cam,
    global real *restrict records,
    global uint *restrict depth_key,
    global int4 *restrict tile_rect,
    ulong capacity,
    uint n_splats,
    int sh_degree,
    int width,
    int height,
    int tiles_x,
    int tiles_y
) {
    const uint first = get_global_id(0) * LANES;
    if (first >= n_splats) return;
    const splat_terms s = splat_project(geom + first, capacity, cam);

    vreal out[RECORD];
    extents box;
    shape_project(s.shown, s.b0, s.b1, s.cov2d, out + HEAD, &box);
    out[HEAD_X] = s.to_px.x;
    out[HEAD_Y] = s.to_px.y;
    out[HEAD_DEPTH] = s.c.z;

    // Pixels whose centres lie in the box. A NaN fails the comparisons below, so such a splat is culled.
    const vreal far = (vreal)R(1e6), half_px = (vreal)R(0.5);
    const vreal x_lo = ceil(lanes_clamp(out[HEAD_X] - box.left - half_px, -far, far));
    const vreal x_hi = floor(lanes_clamp(out[HEAD_X] + box.right - half_px, -far, far));
    const vreal y_lo = ceil(lanes_clamp(out[HEAD_Y] - box.up - half_px, -far, far));
    const vreal y_hi = floor(lanes_clamp(out[HEAD_Y] + box.down - half_px, -far, far));
    out[HEAD_TOP] = y_lo;
    out[HEAD_BOTTOM] = y_hi;
    out[HEAD_LEFT] = x_lo;
    out[HEAD_RIGHT] = x_hi;
    const vmask seen = s.in_front & (box.left + box.right > (vreal)0) & (x_lo <= x_hi) & (y_lo <= y_hi)
                       & (x_hi >= (vreal)0) & (y_hi >= (vreal)0) & (x_lo < (vreal)width) & (y_lo < (vreal)height)
                       & (s.cov2d.xx < (vreal)COV2D_MAX) & (s.cov2d.yy < (vreal)COV2D_MAX);
    if (!lanes_any(seen)) {  // the colour need not be read
        for (int l = 0; l < LANES && first + l < n_splats; ++l) {
            depth_key[first + l] = CULLED_KEY;
            tile_rect[first + l] = (int4)(0, 0, 0, 0);
        }
        return;
    }
    const vreal seen_real = lanes_if(seen, (vreal)1, (vreal)0);

    vreal basis[SH_COUNT], inv_norm;
    sh_basis(unit_direction(cam, s.mean, &inv_norm), sh_degree, basis);
    const int used = (sh_degree + 1) * (sh_degree + 1);
    vreal rgb[3] = {(vreal)R(0.5), (vreal)R(0.5), (vreal)R(0.5)};
    for (int k = 0; k < used; ++k)
        for (int c = 0; c < 3; ++c) rgb[c] += basis[k] * lanes_load(sh + first + (ulong)(3 * k + c) * capacity);
    for (int c = 0; c < 3; ++c) out[HEAD_RED + c] = max(rgb[c], (vreal)0);

    real lane[LANES][RECORD_STRIDE], edge[5][LANES];
    real column[LANES];
    for (int j = 0; j < RECORD_STRIDE; ++j) {
        lanes_store(j < RECORD ? out[j] : (vreal)0, column);
        for (int l = 0; l < LANES; ++l) lane[l][j] = column[l];
    }
    lanes_store(x_lo, edge[0]);
    lanes_store(x_hi, edge[1]);
    lanes_store(y_lo, edge[2]);
    lanes_store(y_hi, edge[3]);
    lanes_store(seen_real, edge[4]);
    for (int l = 0; l < LANES && first + l < n_splats; ++l) {
        const uint i = first + l;
        const bool keep = edge[4][l] > 0;
        store_record(lane[l], record_at(records, i));
        depth_key[i] = keep ? as_uint((float)lane[l][HEAD_DEPTH]) : CULLED_KEY;
        const int4 rect = {
            max((int)edge[0][l], 0) / TILE, max((int)edge[2][l], 0) / TILE, min((int)edge[1][l] / TILE + 1, tiles_x),
            min((int)edge[3][l] / TILE + 1, tiles_y)
        };
        tile_rect[i] = keep ? rect : (int4)(0, 0, 0, 0);
    }
}

// moments [V_RECORD, capacity]: sums over pixels; the last three rows are the gradient of the colour.
// Overwrites grad_geom and grad_sh, which have the rows of geom and sh, with zeros for splats that are not seen; of grad_sh
// only the bands in use. If `compact`, grad_sh is [COMPACT_ROWS, capacity]: the gradient of the colour and the unit direction.
// The gradient of sh is the product of the colour's and the basis in that direction.
// Adds three numbers for densification to statistics [3, capacity] for each seen splat. The first is the norm of the gradient
// of mean_px in units of half the image (3DGS's normalised device coordinates). The second is the absolute gradient along the
// viewing ray [1/world unit] (3DSGS's depth gradient). The third is 1.
kernel void project_splats_vjp(
    global const real *restrict geom,
    global const real *restrict sh,
    constant camera *restrict cam,
    global const real *restrict moments,
    global const real *restrict records,
    global const uint *restrict depth_key,
    global real *restrict grad_geom,
    global real *restrict grad_sh,
    global real *restrict statistics,
    ulong capacity,
    uint n_splats,
    int sh_degree,
    uint compact,
    int width,
    int height
) {
    const uint first = get_global_id(0) * LANES;
    if (first >= n_splats) return;
    const vreal zero = (vreal)0;

    real flag[LANES], seen_rgb[3][LANES];
    for (int l = 0; l < LANES; ++l)
        flag[l] = first + l < n_splats && depth_key[min(first + l, n_splats - 1)] != CULLED_KEY ? 1 : 0;
    const vmask seen = lanes_load(flag) > zero;
    if (!lanes_any(seen)) {  // the result is zeros
        for (int row = 0; row < GEOM_ROWS; ++row) lanes_store(zero, grad_geom + first + row * capacity);
        const int rows = compact ? COMPACT_ROWS : 3 * (sh_degree + 1) * (sh_degree + 1);
        for (int row = 0; row < rows; ++row) lanes_store(zero, grad_sh + first + row * capacity);
        return;
    }
    for (int l = 0; l < LANES; ++l) {
        const ulong i = min(first + l, n_splats - 1);
        for (int c = 0; c < 3; ++c) seen_rgb[c][l] = record_at(records, i)[HEAD_RED + c] > 0 ? flag[l] : 0;
    }
    const splat_terms s = splat_project(geom + first, capacity, cam);

    vreal v[V_RECORD];
    for (int j = 0; j < V_RECORD; ++j) v[j] = lanes_if(seen, lanes_load(moments + first + j * capacity), zero);

    shape_grads g;
    shape_project_vjp(s.shown, s.b0, s.b1, s.cov2d, v, &g);

    // cov2d = B B' + low-pass
    vec3 v_b0 = add3(g.b0, add3(scale3(s.b0, (real)2 * g.cov2d.xx), scale3(s.b1, g.cov2d.xy)));
    vec3 v_b1 = add3(g.b1, add3(scale3(s.b1, (real)2 * g.cov2d.yy), scale3(s.b0, g.cov2d.xy)));
#if ANTIALIASED
    lowered_vjp(s.low, s.s, s.b0, s.b1, &g, &v_b0, &v_b1);
#endif
    // B = A R S
    vec3 v_scale = add3(mul3(v_b0, s.ar0), mul3(v_b1, s.ar1));
    const vec3 v_ar0 = mul3(v_b0, s.scale), v_ar1 = mul3(v_b1, s.scale);
    const vec3 v_a0 = mat3_apply(s.rotation, v_ar0), v_a1 = mat3_apply(s.rotation, v_ar1);
    mat3 v_rotation = {
        add3(scale3(v_ar0, s.a0.x), scale3(v_ar1, s.a1.x)), add3(scale3(v_ar0, s.a0.y), scale3(v_ar1, s.a1.y)),
        add3(scale3(v_ar0, s.a0.z), scale3(v_ar1, s.a1.z))
    };
    // A = J W
    const mat3 w = camera_rotation(cam);
    const projection v_px = {g.mean_x,         g.mean_y,         dot3(v_a0, w.r0),
                             dot3(v_a0, w.r2), dot3(v_a1, w.r1), dot3(v_a1, w.r2)};
    const vec3 v_c = camera_project_vjp(cam, s.c, v_px);
    vec3 v_mean = mat3_apply_transposed(w, v_c);

    const vreal half_x = g.mean_x * (vreal)(R(0.5) * (real)width), half_y = g.mean_y * (vreal)(R(0.5) * (real)height);
    const vreal along_ray = fabs(dot3(v_c, s.c)) / sqrt(dot3(s.c, s.c));
    global real *statistic = statistics + first;
    lanes_store(lanes_load(statistic) + lanes_if(seen, sqrt(half_x * half_x + half_y * half_y), zero), statistic);
    statistic += capacity;
    lanes_store(lanes_load(statistic) + lanes_if(seen, along_ray, zero), statistic);
    statistic += capacity;
    lanes_store(lanes_load(statistic) + lanes_if(seen, (vreal)1, zero), statistic);

    vreal v_rgb[3], inv_norm, v_basis[SH_COUNT];
    for (int c = 0; c < 3; ++c) v_rgb[c] = lanes_if(lanes_load(seen_rgb[c]) > zero, v[SHAPE_V + c], zero);
    // The mean of a splat that is not seen may hold any value, and 0 times a NaN would reach the colour.
    vec3 direction = unit_direction(cam, s.mean, &inv_norm);
    direction =
        (vec3){lanes_if(seen, direction.x, zero), lanes_if(seen, direction.y, zero), lanes_if(seen, direction.z, zero)};
    const int used = (sh_degree + 1) * (sh_degree + 1);
    if (compact) {
        vec3_store((vec3){v_rgb[0], v_rgb[1], v_rgb[2]}, grad_sh + first, capacity);
        vec3_store(direction, grad_sh + first + 3 * capacity, capacity);
    } else {
        vreal basis[SH_COUNT];
        sh_basis(direction, sh_degree, basis);
        UNROLL for (int k = 0; k < SH_COUNT; ++k) for (int c = 0; c < 3 && k < used; ++c)
            lanes_store(basis[k] * v_rgb[c], grad_sh + first + (ulong)(3 * k + c) * capacity);
    }
    // Unrolled, so that GPUs keep the array in registers.
    UNROLL for (int k = 0; k < SH_COUNT; ++k) {
        v_basis[k] = zero;
        for (int c = 0; c < 3 && k < used; ++c)
            v_basis[k] += v_rgb[c] * lanes_load(sh + first + (ulong)(3 * k + c) * capacity);
    }
    vec3 v_direction = sh_basis_vjp(direction, sh_degree, v_basis);
    v_direction = add3(v_direction, scale3(direction, -dot3(direction, v_direction)));
    v_mean = add3(v_mean, scale3(v_direction, inv_norm));

#ifdef SHAPE_CENTRE  // projected point = (x, y, z) + R S centre
    const vec3 stretched = mul3(s.scale, s.centre), v_stretched = mat3_apply_transposed(s.rotation, v_mean);
    v_scale = add3(v_scale, mul3(v_stretched, s.centre));
    v_rotation.r0 = add3(v_rotation.r0, scale3(stretched, v_mean.x));
    v_rotation.r1 = add3(v_rotation.r1, scale3(stretched, v_mean.y));
    v_rotation.r2 = add3(v_rotation.r2, scale3(stretched, v_mean.z));
    shape_centre_vjp(s.s, mul3(v_stretched, s.scale), &g);
#endif

    global real *out = grad_geom + first;
    const vec3 v_log_scale = mul3(v_scale, s.scale);
    vec3_store(
        (vec3){lanes_if(seen, v_mean.x, zero), lanes_if(seen, v_mean.y, zero), lanes_if(seen, v_mean.z, zero)},
        out + ROW_MEAN * capacity, capacity
    );
    vec3_store(
        (vec3){
            lanes_if(seen, v_log_scale.x, zero), lanes_if(seen, v_log_scale.y, zero),
            lanes_if(seen, v_log_scale.z, zero)
        },
        out + ROW_LOG_SCALE * capacity, capacity
    );
    quat_rotation_vjp(s.quat, v_rotation, seen, out + ROW_QUAT * capacity, capacity);
    lanes_store(lanes_if(seen, g.s.opacity * opacity_slope(s.s.opacity), zero), out + ROW_OPACITY_LOGIT * capacity);
    UNROLL for (int row = 0; row < SHAPE_ROWS; ++row)
        lanes_store(lanes_if(seen, g.s.raw[row], zero), out + (SHAPE_FIRST_ROW + row) * capacity);
}
