// payload.js: the splats of the page as arrays of floats. clsplat/splats/formats/page_payload.py describes the format.

// Returns the bytes of base64 text. It works in pieces, so that the page can draw its loading bar.
async function bytesOfBase64(text, progress) {
  const length = (text.length / 4) * 3 - (text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0);
  const bytes = new Uint8Array(length);
  const piece = 1 << 20;
  for (let start = 0, at = 0; start < text.length; start += piece) {
    const part = atob(text.slice(start, start + piece));
    for (let i = 0; i < part.length; ++i) bytes[at++] = part.charCodeAt(i);
    await progress(at / length);
  }
  return bytes;
}

async function unzipped(bytes) {
  if (typeof DecompressionStream === "undefined") throw new Error("This browser is too old for the page. Update it.");
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Returns {head, columns}: columns[name] has width * splats floats, component after component.
async function readPayload(text, progress) {
  const whole = await unzipped(await bytesOfBase64(text, (share) => progress(0.6 * share)));
  const length = new DataView(whole.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(whole.subarray(4, 4 + length)));
  const columns = {};
  let at = 4 + length;
  for (const column of head.columns) {
    const values = new Float32Array(column.width * head.splats);
    for (let c = 0; c < column.width; ++c) {
      readComponent(whole, at, column, c, head.splats, values.subarray(c * head.splats, (c + 1) * head.splats));
      at += column.bytes * head.splats;
    }
    columns[column.name] = values;
    await progress(0.6 + (0.4 * at) / whole.length);
  }
  return { head, columns };
}

function readComponent(whole, at, column, c, n, values) {
  if (column.map === "float") {
    const words = new Uint32Array(values.buffer, values.byteOffset, n);
    for (let b = 0; b < 4; ++b) for (let i = 0; i < n; ++i) words[i] |= whole[at + b * n + i] << (8 * b);
    return;
  }
  const low = column.low[c];
  const high = column.high[c];
  const { largest } = column;
  for (let i = 0; i < n; ++i) {
    let number = 0;
    for (let b = column.bytes - 1; b >= 0; --b) number = number * 256 + whole[at + b * n + i];
    const share = number / largest;
    const side = 2 * share - 1;
    if (column.map === "linear") values[i] = low + share * (high - low);
    else if (column.map === "root") values[i] = side * Math.abs(side) * high;
    else values[i] = low + Math.sign(side) * Math.expm1(Math.abs(side) * high);
  }
}
