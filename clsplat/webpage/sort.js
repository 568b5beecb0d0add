// sort.js: the order of the splats from far to near, in a worker if the browser allows one.

// Returns a function from a row (a, b, c, d) to the indices of the splats by falling depth a x + b y + c z + d. mean has
// all x, then all y, then all z. The radix sort takes 16 bits of a float at a time. It is exact and stable.
function makeSorter(mean) {
  const n = mean.length / 3;
  const keys = new Uint32Array(n);
  const depths = new Float32Array(keys.buffer);
  const half = new Uint32Array(n);
  const counts = [new Uint32Array(65536), new Uint32Array(65536)];
  return (row) => {
    const order = new Uint32Array(n);
    for (const count of counts) count.fill(0);
    for (let i = 0; i < n; ++i) {
      depths[i] = row[0] * mean[i] + row[1] * mean[n + i] + row[2] * mean[2 * n + i] + row[3];
      const bits = keys[i];
      // Bits of positive floats rise with their value, those of negative ones fall. The far ones get the small keys.
      const key = bits & 0x80000000 ? bits : ~bits & 0x7fffffff;
      keys[i] = key;
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
    for (let i = 0; i < n; ++i) half[counts[0][keys[i] & 65535]++] = i;
    for (let i = 0; i < n; ++i) order[counts[1][keys[half[i]] >>> 16]++] = half[i];
    return order;
  };
}

// Sorts for the latest camera. onOrder(order, row) is called with each result.
class Sorter {
  constructor(mean, onOrder) {
    Object.assign(this, { onOrder, busy: false, waiting: null, latest: null });
    try {
      const source = `const make = ${makeSorter};
        let sort;
        onmessage = ({data}) => {
          if (data.mean) sort = make(data.mean);
          else { const order = sort(data.row); postMessage({order, row: data.row}, [order.buffer]); }
        };`;
      this.worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
      this.worker.onmessage = ({ data }) => this.finish(data.order, data.row);
      this.worker.onerror = () => this.withoutWorker(mean);
      this.worker.postMessage({ mean });
    } catch {
      this.withoutWorker(mean);
    }
  }

  // Sorts in the page itself. Some browsers refuse a worker only after it was made.
  withoutWorker(mean) {
    this.worker = null;
    this.sort = makeSorter(mean);
    if (!this.busy) return;
    this.busy = false;
    this.request(this.waiting || this.latest);
  }

  request(row) {
    if (this.busy) {
      this.waiting = row;
      return;
    }
    this.busy = true;
    this.latest = row;
    if (this.worker) this.worker.postMessage({ row });
    else setTimeout(() => this.finish(this.sort(row), row), 0);
  }

  finish(order, row) {
    this.busy = false;
    const next = this.waiting;
    this.waiting = null;
    if (next) this.request(next);
    this.onOrder(order, row);
  }
}
