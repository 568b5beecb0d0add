// phi.glsl: the normal cumulative distribution by Abramowitz & Stegun 7.1.26, with an absolute error of 7.5e-8.
float phi(float z) {
  float t = 1.0 / (1.0 + 0.2316418838 * abs(z));
  float p = ((((1.061405429 * t - 1.453152027) * t + 1.421413741) * t - 0.284496736) * t + 0.254829592) * t;
  float tail = 0.5 * p * exp(-0.5 * z * z);
  return z < 0.0 ? tail : 1.0 - tail;
}
