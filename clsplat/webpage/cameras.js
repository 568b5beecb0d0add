// cameras.js: cameras, and paths between them. Axes of a camera: x right, y down, z forward. A pose is {position, axes},
// where axes are the camera's three axes in the world.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
const length = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scaled(a, 1 / Math.max(length(a), 1e-12));

// Returns the vector turned about a unit axis.
function turned(vector, axis, angle) {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return add(add(scaled(vector, c), cross(axis, vector), s), axis, dot(axis, vector) * (1 - c));
}

// Returns the pose of a camera of the page's settings.
function poseOf(camera) {
  const m = camera.pose;
  const axes = [m.slice(0, 3), m.slice(4, 7), m.slice(8, 11)];
  const t = [m[3], m[7], m[11]];
  const position = scaled(add(add(scaled(axes[0], t[0]), axes[1], t[1]), axes[2], t[2]), -1);
  return { position, axes };
}

// Returns the lens of a camera for a canvas: all of the camera's image is seen, in the middle.
function lensFor(camera, width, height) {
  const scale = Math.min(width / camera.width, height / camera.height);
  return {
    fx: camera.fx * scale,
    fy: camera.fy * scale,
    cx: 0.5 * width + (camera.cx - 0.5 * camera.width) * scale,
    cy: 0.5 * height + (camera.cy - 0.5 * camera.height) * scale,
  };
}

// Returns the point that is nearest to all optical axes, or one in front of the only camera.
function middleOf(cameras, distance) {
  const a = [[1e-9, 0, 0], [0, 1e-9, 0], [0, 0, 1e-9]];
  const b = [0, 0, 0];
  for (const camera of cameras) {
    const { position, axes } = poseOf(camera);
    const d = axes[2];
    for (let i = 0; i < 3; ++i) {
      for (let j = 0; j < 3; ++j) {
        const across = (i === j ? 1 : 0) - d[i] * d[j];
        a[i][j] += across;
        b[i] += across * position[j];
      }
    }
  }
  const columns = [0, 1, 2].map((j) => [a[0][j], a[1][j], a[2][j]]);
  const det = dot(columns[0], cross(columns[1], columns[2]));
  const first = poseOf(cameras[0]);
  if (Math.abs(det) > 1e-3 * cameras.length ** 3) {
    const middle = [
      dot(b, cross(columns[1], columns[2])) / det,
      dot(columns[0], cross(b, columns[2])) / det,
      dot(columns[0], cross(columns[1], b)) / det,
    ];
    if (dot(add(middle, first.position, -1), first.axes[2]) > 0) return middle;
  }
  return add(first.position, first.axes[2], distance);
}

// Returns the pose between two, 0 <= share <= 1.
function between(one, other, share) {
  const position = add(scaled(one.position, 1 - share), other.position, share);
  const z = unit(add(scaled(one.axes[2], 1 - share), other.axes[2], share));
  const y = add(scaled(one.axes[1], 1 - share), other.axes[1], share);
  const x = unit(cross(y, z));
  return { position, axes: [x, cross(z, x), z] };
}
