// splat.vert: the rectangle of pixels that a splat reaches. It has four vertices.
uniform sampler2D projected;  // five texels of a splat: the outputs of project.vert
uniform int splats, batch;    // all splats, and those of an instance
uniform vec2 size;
flat out vec4 vPlace, vForm, vLean;
flat out vec3 vColour;

const int PARTS = 5;  // texels of a splat

void main() {
  int splat = gl_InstanceID * batch + (gl_VertexID >> 2), row = textureSize(projected, 0).x / PARTS;
  ivec2 at = ivec2(splat % row * PARTS, splat / row);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside
  if (splat >= splats) return;
  vec4 box = texelFetch(projected, at, 0);
  if (box.zw == vec2(0.0)) return;
  vec4 rest = texelFetch(projected, at + ivec2(4, 0), 0);
  if ((gl_VertexID & 3) == 3) {  // the corner whose flat values a triangle takes
    vPlace = texelFetch(projected, at + ivec2(1, 0), 0);
    vForm = texelFetch(projected, at + ivec2(2, 0), 0);
    vLean = texelFetch(projected, at + ivec2(3, 0), 0);
    vColour = vec3(vForm.w, rest.xy);
  }
  vec2 other = rest.z * normalize(vec2(-box.w, box.z));
  vec2 px = box.xy + float(gl_VertexID & 1) * box.zw + float((gl_VertexID >> 1) & 1) * other;
  gl_Position = vec4(2.0 * px / size - 1.0, 0.0, 1.0);
}
