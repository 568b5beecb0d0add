// main.js: the page. It reads the splats, draws them when something changes, and answers the buttons.

// While the view moves, the image is smaller on slow devices. Sizes are shares of the screen's width and height. If the
// smallest image is too slow as well, the faintest of its splats are left out.
const SMALLEST = 0.25;
const FEWEST = 0.5;          // the part of the splats that stays
const STEP = 1.05;           // factor of the size or of that part from one picture to the next
const SLOW = 60, FAST = 25;  // time that a picture takes [ms] above which the image shrinks, below which it grows
const REST = 250;            // time without a change [ms] after which the image has its full size
const find = (id) => document.getElementById(id);

class Page {
  constructor(settings) {
    this.settings = settings;
    this.canvas = find("view");
    this.changed = true;
    this.touring = null;
    this.sortedView = null;  // the view (sort.js) whose order the renderer has
    this.drawnView = null;   // the same for the last picture
    this.share = 1;     // size of the image while the view moves
    this.part = 1;      // part of its splats, below 1 only in the smallest image
    this.whole = true;  // whether the last picture had its full size, or the next one will
    this.ordered = false;  // whether a picture of full size waits for nothing but its drawing
    this.gap = null;    // mean time that a picture of a view that moves takes [ms]
    this.cameras = settings.cameras.length ? settings.cameras : settings.tour.cameras;
    this.background = settings.background;
  }

  async open() {
    const payload = await readPayload(find("payload").textContent, (share) => this.loaded(share));
    find("payload").textContent = "";
    this.renderer = new Renderer(this.canvas, payload, this.settings.shaders);
    const { columns, head } = payload;
    const splats = { mean: columns.mean, reach: reachOf(columns), near: head.near_plane, opacity: columns.opacity };
    splats.blur = head.antialiased ? 0 : head.low_pass;
    this.sorter = new Sorter(splats, (order, view) => this.sorted(order, view));
    this.controls = new Controls(this.canvas, () => this.moved());
    const tour = this.settings.tour.cameras;
    this.middle = middleOf(tour.concat(this.settings.cameras), 3);
    const ups = tour.map((camera) => scaled(poseOf(camera).axes[1], -1));
    this.controls.up = unit(ups.reduce((sum, up) => add(sum, up), [0, 0, 0]));
    this.buttons(payload.head);
    this.jump(0);
    find("loading").hidden = true;
    this.last = performance.now();
    requestAnimationFrame((now) => this.frame(now));
  }

  async loaded(share) {
    find("loading-bar").value = share;
    await new Promise((resolve) => setTimeout(resolve, 0));
  }

  buttons(head) {
    const list = find("cameras");
    this.cameras.forEach((camera, i) => list.add(new Option(camera.name || `view ${i + 1}`, i)));
    let byPointer = false;
    list.onpointerdown = () => { byPointer = true; };
    list.onkeydown = () => { byPointer = false; };
    list.onchange = () => {
      this.jump(Number(list.value));
      if (byPointer) this.canvas.focus();  // so that keys move the camera. Who walks through the list by keys stays there
    };
    find("previous").onclick = () => this.jump(this.index - 1);
    find("next").onclick = () => this.jump(this.index + 1);
    find("reset").onclick = () => this.jump(0);
    find("tour").onclick = () => this.tour(!this.touring);
    const hex = (part) => Math.round(255 * part).toString(16).padStart(2, "0");
    find("background").value = `#${this.background.map(hex).join("")}`;
    find("background").oninput = (event) => {
      this.background = [1, 3, 5].map((at) => parseInt(event.target.value.slice(at, at + 2), 16) / 255);
      this.changed = true;
    };
    find("fullscreen").onclick = () =>
      document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen();
    find("help-button").onclick = () => find("help").showModal();
    find("about").textContent = `${head.splats.toLocaleString("en")} splats, drawn with WebGL 2. Made by clsplat.`;
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("resize", () => {
      this.changed = true;
    });
    this.canvas.addEventListener("dblclick", (event) => this.aim(event));
    const lost = new Error("The graphics device was lost. Reload the page.");
    this.canvas.addEventListener("webglcontextlost", () => this.fail(lost));
  }

  key(event) {
    if (needsKeys(event.target)) return;
    const buttons = { ",": "previous", ".": "next", t: "tour", r: "reset", f: "fullscreen", h: "help-button" };
    const button = buttons[event.key.toLowerCase()];
    if (button && !event.ctrlKey && !event.metaKey && !event.altKey) find(button).click();
  }

  // Goes to a camera of the list.
  jump(index) {
    this.tour(false);
    this.index = (index + this.cameras.length) % this.cameras.length;
    find("cameras").value = this.index;
    this.camera = this.cameras[this.index];
    this.controls.set(poseOf(this.camera), this.middle);
    this.changed = true;
  }

  tour(on) {
    this.touring = on ? { at: 0 } : null;
    find("tour").setAttribute("aria-pressed", String(on));
    this.changed = true;
  }

  moved() {
    if (this.touring) this.tour(false);
    this.changed = true;
  }

  // Turns around the splats under the pointer: the depth is that of the nearest centre beside the ray.
  aim(event) {
    const { mean } = this.renderer.payload.columns;
    const { n } = this.renderer;
    const box = this.canvas.getBoundingClientRect();
    const scale = this.canvas.width / box.width;
    const lens = lensFor(this.camera, this.canvas.width, this.canvas.height);
    const { position, axes } = this.controls.pose;
    const x = ((event.clientX - box.left) * scale - lens.cx) / lens.fx;
    const y = ((event.clientY - box.top) * scale - lens.cy) / lens.fy;
    let depth = Infinity;
    const near = this.renderer.payload.head.near_plane;
    for (let i = 0; i < n; ++i) {
      const d = [mean[i] - position[0], mean[n + i] - position[1], mean[2 * n + i] - position[2]];
      const z = dot(axes[2], d);
      if (z <= near || z >= depth || this.renderer.payload.columns.opacity[i] < 0.3) continue;
      const off = Math.hypot(dot(axes[0], d) / z - x, dot(axes[1], d) / z - y);
      if (off < 8 / lens.fx) depth = z;
    }
    if (depth === Infinity) return;
    const ray = add(add(scaled(axes[0], x), axes[1], y), axes[2]);
    const place = add(position, ray, depth);
    const z = unit(add(place, position, -1));
    const x1 = unit(cross(axes[1], z));
    this.controls.pose.axes = [x1, cross(z, x1), z];
    this.controls.target = place;
    this.moved();
  }

  sorted(order, view) {
    this.renderer.setOrder(order);
    this.sortedView = view;
    if (!this.whole) this.changed = true;
    else if (this.isPresent(view)) this.ordered = true;
  }

  frame(now) {
    const seconds = Math.min((now - this.last) / 1000, 0.1);
    this.last = now;
    if (this.touring) this.tourStep(seconds);
    if (this.controls.advance(seconds)) this.changed = true;
    const took = this.renderer.poll(now);
    if (took !== null) this.adapt(took);
    // A fast device may have the next picture while it still draws one. A slow one would only be more and more behind.
    if (this.renderer.drawing.length < (this.gap !== null && this.gap < SLOW ? 2 : 1)) this.advance(now);
    requestAnimationFrame((next) => this.frame(next));
  }

  // Draws a picture if one is due.
  advance(now) {
    if (this.changed) {
      this.draw(this.share, now, true);
    } else if (now - this.lastDraw > REST && (!this.whole || this.gap !== null)) {
      this.gap = null;
      if (this.whole) this.describe();
      else this.rest(now);
    } else if (this.ordered) {
      this.draw(1, now);
    }
  }

  tourStep(seconds) {
    const { cameras, fps, closed } = this.settings.tour;
    const steps = Math.max(closed ? cameras.length : cameras.length - 1, 1);
    this.touring.at = (this.touring.at + seconds * fps) % steps;
    const first = Math.floor(this.touring.at);
    const pair = [cameras[first], cameras[(first + 1) % cameras.length]];
    this.camera = pair[0];
    this.controls.set(between(poseOf(pair[0]), poseOf(pair[1]), this.touring.at - first), this.middle);
    this.changed = true;
  }

  // Draws the view at its full size, as soon as all of its splats are in order.
  rest(now) {
    this.whole = true;
    if (this.isPresent(this.sortedView)) this.draw(1, now);
    else this.sorter.request(this.view);
  }

  // Chooses the size of the next image, and the part of its splats, from the time that one took [ms].
  adapt(took) {
    this.gap = 0.9 * (this.gap || took) + 0.1 * took;
    if (took > SLOW) {
      if (this.share === SMALLEST) this.part = Math.max(this.part / STEP, FEWEST);
      else this.share = Math.max(this.share * Math.sqrt(SLOW / took), SMALLEST);
    } else if (took < FAST) {
      if (this.part < 1) this.part = Math.min(this.part * STEP, 1);
      else this.share = Math.min(this.share * STEP, 1);
    }
  }

  draw(share, now, moving = false) {
    this.changed = this.ordered = false;
    this.whole = share === 1;
    this.lastDraw = now;
    const density = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(this.canvas.clientWidth * density), 1);
    const height = Math.max(Math.round(this.canvas.clientHeight * density), 1);
    this.renderer.resize(width, height, share);
    if (!this.isPresent(this.sortedView)) this.sorter.request(this.view);
    this.renderer.draw(this.controls.pose, lensFor(this.camera, ...this.renderer.size), this.background);
    this.renderer.note(now, moving);
    this.drawnView = this.sortedView;
    this.describe();
  }

  describe() {
    const count = this.renderer.n.toLocaleString("en");
    const rate = this.gap ? `, ${Math.round(1000 / this.gap)} a second` : "";
    find("info").textContent = `${count} splats${rate}`;
  }

  // The present view for the sort. Pixels are those of the smallest image, so that its size does not matter.
  get view() {
    const { position, axes } = this.controls.pose;
    const { width, height } = this.canvas;
    const { fx, fy, cx, cy } = lensFor(this.camera, width, height);
    const edges = [-cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy];
    const part = this.whole ? 1 : this.part;
    return [...axes.flat(), ...position, ...edges, 1 / (SMALLEST * fx), 1 / (SMALLEST * fy), part];
  }

  // Whether a view of the sort is the present one.
  isPresent(view) {
    return view !== null && this.view.every((value, i) => value === view[i]);
  }

  // True if the picture shows the present view at its full size, with its splats in order.
  get settled() {
    return Boolean(this.controls) && !this.changed && this.whole && this.isPresent(this.drawnView);
  }

  fail(error) {
    find("loading").hidden = false;
    find("loading-bar").hidden = true;
    find("loading-text").textContent = error.message;
  }
}

const page = new Page(JSON.parse(find("settings").textContent));
page.open().catch((error) => page.fail(error));
