// controls.js: moves the camera by mouse, touch and keys. The camera turns around a target, or flies.

// Whether an element uses keys itself: a list, the choice of a colour, or the help. Buttons do not use letters and arrows.
function needsKeys(target) {
  return Boolean(target.closest?.("select, input, dialog"));
}


const FLY = 0.8;     // distances to the target in a second
const LOOK = 0.9;    // radians in a second
const STEEP = 0.99;  // largest cosine between the view and the up direction: the camera never turns over

class Controls {
  constructor(canvas, onChange) {
    Object.assign(this, { canvas, onChange, keys: new Set(), pointers: new Map() });
    this.pose = null;
    this.target = [0, 0, 0];
    this.up = [0, -1, 0];
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.release(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.keys.clear());
  }

  // Sets the pose of a camera, and the place that it turns around: ahead, as far away as the middle of the scene.
  set(pose, middle) {
    this.pose = pose;
    const ahead = Math.max(dot(add(middle, pose.position, -1), pose.axes[2]), 1e-3);
    this.target = add(pose.position, pose.axes[2], ahead);
  }

  get distance() {
    return Math.max(dot(add(this.target, this.pose.position, -1), this.pose.axes[2]), 1e-6);
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.classList.add("dragging");
    this.canvas.focus();
    const pans = event.button === 2 || event.shiftKey;
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, pans });
  }

  release(event) {
    this.pointers.delete(event.pointerId);
    if (!this.pointers.size) this.canvas.classList.remove("dragging");
  }

  move(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer || !this.pose) return;
    const dx = event.clientX - pointer.x;
    const dy = event.clientY - pointer.y;
    const others = [...this.pointers.entries()].filter(([id]) => id !== event.pointerId);
    if (others.length) {  // two fingers: move sideways, and come closer as they part
      const other = others[0][1];
      const before = Math.hypot(pointer.x - other.x, pointer.y - other.y);
      const after = Math.hypot(event.clientX - other.x, event.clientY - other.y);
      this.pan(0.5 * dx, 0.5 * dy);
      if (before > 0 && after > 0) this.dolly(before / after);
    } else if (pointer.pans) this.pan(dx, dy);
    else this.orbit(dx, dy);
    Object.assign(pointer, { x: event.clientX, y: event.clientY });
    this.onChange();
  }

  wheel(event) {
    event.preventDefault();
    if (!this.pose) return;
    const lines = event.deltaMode === 1 ? 30 : 1;
    this.dolly(Math.exp(0.001 * Math.max(Math.min(event.deltaY * lines, 300), -300)));
    this.onChange();
  }

  key(event, down) {
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (!down) {  // wherever it is released, and with which other key
      this.keys.delete(name);
      return;
    }
    if (needsKeys(event.target)) return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (!"wasdqe".includes(name) && !name.startsWith("Arrow")) return;
    this.keys.add(name);
    event.preventDefault();
    this.onChange();
  }

  // Does what the pressed keys say for some seconds. Returns whether there is a pressed key.
  advance(seconds) {
    if (!this.keys.size || !this.pose) return false;
    const held = (one, other) => Number(this.keys.has(one)) - Number(this.keys.has(other));
    const step = FLY * this.distance * seconds;
    const { axes } = this.pose;
    let way = scaled(axes[2], step * held("w", "s"));
    way = add(way, axes[0], step * held("d", "a"));
    way = add(way, this.up, step * held("e", "q"));
    this.pose.position = add(this.pose.position, way);
    this.target = add(this.target, way);
    this.look(LOOK * seconds * held("ArrowRight", "ArrowLeft"), LOOK * seconds * held("ArrowUp", "ArrowDown"));
    return true;
  }

  orbit(dx, dy) {
    const distance = this.distance;
    const angle = 2.5 / Math.max(this.canvas.clientHeight, 1);
    this.turn(-dx * angle, dy * angle);
    this.pose.position = add(this.target, this.pose.axes[2], -distance);
  }

  look(right, up) {
    if (!right && !up) return;
    const distance = this.distance;
    this.turn(right, up);
    this.target = add(this.pose.position, this.pose.axes[2], distance);
  }

  // Turns the camera's axes to the right about the up direction, and upwards about its x axis.
  turn(right, up) {
    const axis = this.up;
    let axes = this.pose.axes.map((each) => turned(each, axis, -right));
    const tipped = axes.map((each) => turned(each, axes[0], up));
    const steepness = Math.abs(dot(tipped[2], axis));
    if (steepness < STEEP || steepness < Math.abs(dot(axes[2], axis))) axes = tipped;
    const x = unit(add(axes[0], axes[2], -dot(axes[0], axes[2])));
    this.pose.axes = [x, cross(axes[2], x), axes[2]];
  }

  pan(dx, dy) {
    const step = this.distance / Math.max(this.canvas.clientHeight, 1);
    const way = add(scaled(this.pose.axes[0], -dx * step), this.pose.axes[1], -dy * step);
    this.pose.position = add(this.pose.position, way);
    this.target = add(this.target, way);
  }

  dolly(factor) {
    this.pose.position = add(this.target, this.pose.axes[2], -this.distance * factor);
  }
}
