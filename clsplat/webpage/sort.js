// sort.js: the order of the splats from far to near, in a worker if the browser allows one.

// Returns a function from a row (a, b, c, d) to the indices of the splats by falling depth a x + b y + c z + d. mean has
// all x, then all y, then all z. The sort is by radix, 16 bits at a time, over the bits of a float: exact, and stable.
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
    this.onOrder = onOrder;
    this.busy = false;
    this.waiting = null;
    try {
      const source = `const sorter = (${makeSorter})(new Float32Array(0)); let sort = sorter;
        onmessage = ({data}) => {
          if (data.mean) sort = (${makeSorter})(data.mean);
          else { const order = sort(data.row); postMessage({order, row: data.row}, [order.buffer]); }
        };`;
      this.worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
      this.worker.onmessage = ({ data }) => this.finish(data.order, data.row);
      this.worker.postMessage({ mean });
    } catch {
      this.worker = null;
      this.sort = makeSorter(mean);
    }
  }

  request(row) {
    if (this.busy) {
      this.waiting = row;
      return;
    }
    this.busy = true;
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
