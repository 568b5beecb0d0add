// screen.frag: the image over the background, with row 0 at the top. A smaller image is enlarged (bilinear).
uniform sampler2D image;
uniform vec3 background;
uniform vec2 size;  // of the screen [px]
out vec4 colour;

void main() {
  ivec2 last = textureSize(image, 0) - 1;
  vec2 place = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) * vec2(last + 1) / size - 0.5;
  ivec2 low = ivec2(floor(place));
  vec2 share = place - vec2(low);
  vec4 sum = vec4(0.0);
  for (int k = 0; k < 4; ++k) {
    ivec2 step = ivec2(k & 1, k >> 1);
    vec2 weight = mix(1.0 - share, share, vec2(step));
    if (weight.x * weight.y > 0.0) sum += weight.x * weight.y * texelFetch(image, clamp(low + step, ivec2(0), last), 0);
  }
  colour = vec4(sum.rgb + (1.0 - sum.a) * background, 1.0);
}
