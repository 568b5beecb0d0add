// sort.js: the splats that a view can show, from far to near, in a worker if the browser allows one.

// Returns for each splat how far it reaches at most, in standard deviations along its longest axis and in that length:
// {factor, size}. The bounds are those of project.vert for a splat that leans as far as it can, with twice its opacity.
function reachOf({ log_scale: logScale, opacity, beta }) {
  const n = opacity.length;
  const factor = new Float32Array(n);
  const size = new Float32Array(n);
  for (let i = 0; i < n; ++i) {
    const fall = Math.log(Math.max(510 * opacity[i], 1));
    const radius = Math.sqrt(2 * (beta ? Math.max(fall ** (2 / beta[i]), fall) : fall));
    factor[i] = 1.65 * radius + 1.31;
    size[i] = Math.exp(Math.max(logScale[i], logScale[n + i], logScale[2 * n + i]));
  }
  return { factor, size };
}

// Returns a function from a view to the indices of the splats that it can show, by falling depth. mean has all x, then
// all y, then all z. A view is a list: the three axes of the camera, its position, the left, right, upper and lower edge
// of the image as tangents, the size of a pixel as a tangent in both directions, and the part of the splats to keep.
// Splats outside of the image stay if they reach into it, or into a margin around it, because the camera moves on while
// the order is made. With a part below 1, those with the least opacity times length on the image are left out. blur is
// the variance that a model without antialiasing adds to each splat [px^2].
// The radix sort takes 16 bits of a float at a time. It is exact and stable.
function makeSorter({ mean, reach, near, opacity, blur }) {
  const MARGIN = 0.1;  // of the image's width and height
  const n = mean.length / 3;
  const keys = new Uint32Array(n);
  const depths = new Float32Array(keys.buffer);
  const shown = new Uint32Array(n);
  const half = new Uint32Array(n);
  const counts = [new Uint32Array(65536), new Uint32Array(65536)];
  const weights = new Float32Array(n);
  const weightBits = new Uint32Array(weights.buffer);

  // Keeps this part of the first `found` splats, and returns their number. Weights are squares, told apart by 16 bits.
  function keepHeaviest(found, part, pixel) {
    const count = counts[0].fill(0);
    for (let k = 0; k < found; ++k) {
      const length = reach.size[shown[k]] / depths[k] / pixel;
      weights[k] = opacity[shown[k]] ** 2 * (length * length + blur);
      count[weightBits[k] >>> 16]++;
    }
    let least = 0;
    for (let out = count[0]; out <= (1 - part) * found; out += count[++least]);
    let kept = 0;
    for (let k = 0; k < found; ++k) {
      if (weightBits[k] >>> 16 < least) continue;
      shown[kept] = shown[k];
      depths[kept++] = depths[k];
    }
    return kept;
  }

  return (view) => {
    const [ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz, left, right, top, bottom, pixelX, pixelY, part] = view;
    const [sideX, sideY] = [MARGIN * (right - left), MARGIN * (bottom - top)];
    const farX = 2 * Math.max(Math.abs(left), Math.abs(right));
    const farY = 2 * Math.max(Math.abs(top), Math.abs(bottom));
    let found = 0;
    for (let i = 0; i < n; ++i) {
      const x = mean[i] - px;
      const y = mean[n + i] - py;
      const z = mean[2 * n + i] - pz;
      const depth = cx * x + cy * y + cz * z;
      if (!(depth > 0.5 * near)) continue;  // project.vert decides about those near the plane
      const tx = (ax * x + ay * y + az * z) / depth;
      const ty = (bx * x + by * y + bz * z) / depth;
      const wide = reach.size[i] / depth;
      const lengthX = reach.factor[i] * (wide * Math.sqrt(1 + Math.min(tx * tx, farX * farX)) + 0.55 * pixelX) + sideX;
      const lengthY = reach.factor[i] * (wide * Math.sqrt(1 + Math.min(ty * ty, farY * farY)) + 0.55 * pixelY) + sideY;
      if (tx + lengthX < left || tx - lengthX > right || ty + lengthY < top || ty - lengthY > bottom) continue;
      depths[found] = depth;
      shown[found++] = i;
    }
    if (part < 1 && found) found = keepHeaviest(found, part, pixelX);
    for (const count of counts) count.fill(0);
    for (let k = 0; k < found; ++k) {
      const key = ~keys[k] & 0x7fffffff;  // bits of positive floats rise with their value: the far ones come first
      keys[k] = key;
      counts[0][key & 65535]++;
      counts[1][key >>> 16]++;
    }
    for (const count of counts) {
      let sum = 0;
      for (let k = 0; k < 65536; ++k) {
        const next = sum + count[k];
        count[k] = sum;
        sum = next;
      }
    }
    const order = new Uint32Array(found);
    for (let k = 0; k < found; ++k) half[counts[0][keys[k] & 65535]++] = k;
    for (let k = 0; k < found; ++k) order[counts[1][keys[half[k]] >>> 16]++] = shown[half[k]];
    return order;
  };
}

// Sorts for the latest view. onOrder(order, view) is called with each result.
class Sorter {
  constructor(splats, onOrder) {
    Object.assign(this, { splats, onOrder, busy: false, waiting: null, latest: null });
    try {
      const source = `const make = ${makeSorter};
        let sort;
        onmessage = ({data}) => {
          if (data.splats) sort = make(data.splats);
          else { const order = sort(data.view); postMessage({order, view: data.view}, [order.buffer]); }
        };`;
      this.worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
      this.worker.onmessage = ({ data }) => this.finish(data.order, data.view);
      this.worker.onerror = () => this.withoutWorker();
      this.worker.postMessage({ splats });
    } catch {
      this.withoutWorker();
    }
  }

  // Sorts in the page itself. Some browsers refuse a worker only after it was made.
  withoutWorker() {
    this.worker = null;
    this.sort = makeSorter(this.splats);
    if (!this.busy) return;
    this.busy = false;
    this.request(this.waiting || this.latest);
  }

  request(view) {
    if (this.busy) {
      this.waiting = view;
      return;
    }
    this.busy = true;
    this.latest = view;
    if (this.worker) this.worker.postMessage({ view });
    else setTimeout(() => this.finish(this.sort(view), view), 0);
  }

  finish(order, view) {
    this.busy = false;
    const next = this.waiting;
    this.waiting = null;
    if (next) this.request(next);
    this.onOrder(order, view);
  }
}
