// project.vert: a splat on the screen, as cl/render/project.cl and cl/shape/skew_normal.clh compute it. A Gaussian is a
// skew-normal without skew. So is a generalised exponential, but for its height and reach. Transform feedback keeps the
// outputs, far splats first.

layout(location = 0) in uint splat;
uniform sampler2D geometry, colour;  // texels of a splat: see renderer.js
uniform mat3 rotation;               // from the world to the camera
uniform vec3 translation, eye;
uniform vec4 lens, bounds;  // fx, fy, cx, cy [px]; lowest and highest x/z, then y/z, in the Jacobian
uniform vec2 size;          // of the image [px]
uniform float near;
uniform float lowPass;  // variance that widens each splat [px^2]
uniform float cutoff;  // smallest alpha of a pixel
uniform int normalisation, antialiased, degree;
uniform int exponential;  // 1: generalised exponentials, cl/shape/generalised_exponential.clh

out vec4 box;    // a rectangle [px]: a corner, and the edge from it; no edge: nothing to draw
out vec4 place;  // centre [px], amplitude, offset or half of beta
out vec4 form;   // -d'Pd/2 as three coefficients; red
out vec4 lean;   // g, slope
out vec4 rest;   // green, blue, the rectangle's other edge, unused

const float SKEW_SQUARE = 1.69977443;
const float KAPPA = 0.57079632679, HALF_PI = 1.57079632679;
const float DENSITY_0 = 0.3989422804;  // of the normal distribution at 0

// The logarithm of the kernel's peak: cl/shape/skew_pixel.clh, peak_ratio.
float logPeak(float c) {
  float r = 0.79788456 / (1.0 + 0.5 * c / (1.0 + 0.05 * sqrt(c)));
  for (int i = 0; i < 3; ++i) {
    float s = c * r, ratio = DENSITY_0 * exp(-0.5 * s * s) / phi(s);
    r -= (r - ratio) / (1.0 + c * ratio * (s + ratio));
  }
  return log(phi(c * r)) - 0.5 * c * r * r;
}

float radius(float amplitude) { return sqrt(2.0 * log(max(amplitude / cutoff, 1.0))); }

// How far the splat reaches on one side: skew_extent.
float extent(float v, float variance, float t, float r1, float r2) {
  float chord = sqrt(max(variance - v * v / max(t, 1e-12), 0.0));
  float suppressed = sqrt(max(variance - KAPPA * v * v, 0.0));
  return v >= 0.0 ? r1 * sqrt(variance + v * v) : max(r1 * chord, r2 * suppressed);
}

vec3 texelOf(int k, int texels) {
  int at = int(splat) * texels + k, width = textureSize(colour, 0).x;
  return texelFetch(colour, ivec2(at % width, at / width), 0).rgb;
}

vec3 colourOf(vec3 d) {
  int texels = (degree + 1) * (degree + 1);
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.5 + 0.28209479177387814 * texelOf(0, texels);
  if (degree >= 1)
    sum += 0.4886025119029199 * (-y * texelOf(1, texels) + z * texelOf(2, texels) - x * texelOf(3, texels));
  if (degree >= 2)
    sum += 1.0925484305920792 * (x * y * texelOf(4, texels) - y * z * texelOf(5, texels) - x * z * texelOf(7, texels))
      + 0.31539156525252005 * (2.0 * zz - xx - yy) * texelOf(6, texels)
      + 0.54627421529603959 * (xx - yy) * texelOf(8, texels);
  if (degree >= 3)
    sum += -0.59004358992664352 * y * (3.0 * xx - yy) * texelOf(9, texels)
      + 2.8906114426405540 * x * y * z * texelOf(10, texels)
      - 0.45704579946446577 * y * (4.0 * zz - xx - yy) * texelOf(11, texels)
      + 0.37317633259011546 * z * (2.0 * zz - 3.0 * (xx + yy)) * texelOf(12, texels)
      - 0.45704579946446577 * x * (4.0 * zz - xx - yy) * texelOf(13, texels)
      + 1.4453057213202770 * z * (xx - yy) * texelOf(14, texels)
      - 0.59004358992664352 * x * (xx - 3.0 * yy) * texelOf(15, texels);
  return max(sum, 0.0);
}

void main() {
  box = place = form = lean = rest = vec4(0.0);
  gl_Position = vec4(0.0);

  int width = textureSize(geometry, 0).x, first = 4 * int(splat);
  ivec2 at = ivec2(first % width, first / width);
  vec4 mean = texelFetch(geometry, at, 0), scale = texelFetch(geometry, at + ivec2(1, 0), 0);
  vec4 q = texelFetch(geometry, at + ivec2(2, 0), 0), skew = texelFetch(geometry, at + ivec2(3, 0), 0);
  float opacity = mean.w;

  vec3 c = rotation * mean.xyz + translation;
  if (!(c.z >= near)) return;
  float rz = 1.0 / c.z;
  vec2 tangent = c.xy * rz, focal = lens.xy * rz;
  vec2 centre = lens.xy * tangent + lens.zw;
  vec2 clamped = clamp(tangent, bounds.xz, bounds.yw);
  vec3 row0 = vec3(rotation[0].x, rotation[1].x, rotation[2].x);
  vec3 row1 = vec3(rotation[0].y, rotation[1].y, rotation[2].y);
  vec3 row2 = vec3(rotation[0].z, rotation[1].z, rotation[2].z);
  vec3 a0 = focal.x * (row0 - clamped.x * row2), a1 = focal.y * (row1 - clamped.y * row2);
  mat3 turn = mat3(  // columns: the axes of the splat
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  vec3 b0 = (a0 * turn) * scale.xyz, b1 = (a1 * turn) * scale.xyz;

  vec3 m = skew.xyz * min(sqrt(SKEW_SQUARE / max(dot(skew.xyz, skew.xyz), 1e-20)), 1.0);
  vec3 area = cross(b0, b1);
  float flatness = dot(area, area);
  float xx = dot(b0, b0) + lowPass, xy = dot(b0, b1), yy = dot(b1, b1) + lowPass;
  float det = flatness + lowPass * (xx + yy - lowPass);
  vec3 conic = vec3(yy, -xy, xx) / det;
  vec2 v = vec2(dot(b0, m), dot(b1, m));
  vec2 u = vec2(conic.x * v.x + conic.y * v.y, conic.y * v.x + conic.z * v.y);
  float t = clamp(dot(u, v), 0.0, SKEW_SQUARE), oneT = 1.0 / (1.0 + t), oneKt = 1.0 / (1.0 - KAPPA * t);
  float h = sqrt(HALF_PI * oneT * oneKt), steep = HALF_PI * t * oneKt, normSteep = steep;
  if (antialiased == 1) {
    float mm = dot(m, m), along = dot(area, m), stretched = (1.0 + mm) * flatness - along * along;
    float whole = stretched + lowPass * (xx + yy - lowPass + v.x * v.x + v.y * v.y);
    opacity *= sqrt(stretched / whole);
    float inv = flatness > 1e-24 ? inversesqrt(flatness) : 0.0;
    float sharp = clamp(mm - along * along * inv * inv, 0.0, SKEW_SQUARE);
    normSteep = HALF_PI * sharp / (1.0 - KAPPA * sharp);
  }
  float logNorm = normalisation == 0 ? -logPeak(normSteep) : normalisation == 1 ? 0.69314718056 : 0.0;
  float amplitude = opacity * exp(logNorm);
  float bound = amplitude * phi(radius(amplitude) * sqrt(steep));
  float r1 = radius(bound), r2 = radius(0.5 * amplitude);
  if (exponential == 1) {
    amplitude = opacity;
    r1 = r2 = sqrt(2.0 * pow(log(max(opacity / cutoff, 1.0)), 2.0 / skew.w));
  }
  vec4 reach = vec4(extent(-v.x, xx, t, r1, r2) + v.x, extent(v.x, xx, t, r1, r2) - v.x,
    extent(-v.y, yy, t, r1, r2) + v.y, extent(v.y, yy, t, r1, r2) - v.y);
  vec2 low = ceil(centre - reach.xz - 0.5), high = floor(centre + reach.yw - 0.5);
  bool seen = reach.x + reach.y > 0.0 && all(lessThanEqual(low, high)) && all(greaterThanEqual(high, vec2(0.0)))
    && all(lessThan(low, size)) && xx < 1e12 && yy < 1e12;
  if (!seen) return;

  vec3 rgb = colourOf(normalize(mean.xyz - eye));
  // Every pixel is in the ellipse of C + vv' about the location as well. Its rectangle along the axes may be smaller.
  vec2 corner = max(low, 0.0), edges = min(high, size - 1.0) - corner + 1.0;
  vec3 grown = vec3(xx + v.x * v.x, xy + v.x * v.y, yy + v.y * v.y);
  float middle = 0.5 * (grown.x + grown.z), tilt = 0.5 * (grown.x - grown.z), gap = length(vec2(tilt, grown.y));
  vec2 halves = 1.001 * r1 * sqrt(vec2(middle + gap, max(middle - gap, 0.0))) + 0.01;
  vec2 axis = gap < 1e-6 * middle ? vec2(1.0, 0.0)
    : normalize(tilt > 0.0 ? vec2(tilt + gap, grown.y) : vec2(grown.y, gap - tilt));
  box = vec4(corner, edges.x, 0.0);
  rest.z = edges.y;
  if (4.0 * halves.x * halves.y < edges.x * edges.y) {
    box = vec4(centre - v - halves.x * axis - halves.y * vec2(-axis.y, axis.x), 2.0 * halves.x * axis);
    rest.z = 2.0 * halves.y;
  }
  place = vec4(centre, amplitude * exp(-0.5 * t * oneT), exponential == 1 ? 0.5 * skew.w : h * t);
  vec3 plain = conic - oneT * vec3(u.x * u.x, u.x * u.y, u.y * u.y);
  form = vec4(-0.5 * plain.x, -plain.y, -0.5 * plain.z, rgb.r);
  lean = vec4(u * oneT, h * u);
  rest.xy = rgb.gb;
}
