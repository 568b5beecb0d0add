// splat.frag: alpha of a pixel, as cl/shape/skew_pixel.clh, cl/shape/generalised_exponential.clh and cl/render/blend.clh
// compute it. Row 0 of the image is at the bottom here.
uniform int exponential;  // 1: generalised exponentials
uniform float cutoff;     // smallest alpha of a pixel
flat in vec4 vPlace, vForm, vLean;
flat in vec3 vColour;
out vec4 colour;

void main() {
  vec2 d = gl_FragCoord.xy - vPlace.xy;
  float e = d.x * (d.x * vForm.x + d.y * vForm.y - vLean.x) + d.y * (d.y * vForm.z - vLean.y);
  float height;
  if (exponential == 1) {
    height = exp(-exp(min(vPlace.w * log(max(-e, 1e-30)), 10.0)));
  } else {
    float u = dot(vLean.zw, d) + vPlace.w;
    height = exp(e) * (u == 0.0 ? 0.5 : phi(u));
  }
  float alpha = min(vPlace.z * height, 0.99);
  if (!(alpha >= cutoff)) discard;
  colour = vec4(vColour * alpha, alpha);
}
