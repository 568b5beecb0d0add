// renderer.js: draws the splats with WebGL 2. One pass projects each splat once, in the order of the sort (transform
// feedback). The results go to a texture without leaving the device. A second pass blends a rectangle for each splat,
// from far to near, into an image of 16-bit floats: 8 bits would round at every splat. A last pass puts the image over
// the background.

const TEXELS = 4096;  // width of the textures that hold the splats
const PARTS = 5;      // texels of a projected splat
const ROW = 800;      // projected splats in a row of their texture
const BATCH = 1024;   // splats of a drawn instance: a single one would be a slow instance, on processors above all
// Smallest alpha of a pixel: that of clsplat's kernels, and one for images below full size. Most pixels of the rectangles
// are faint, and the time of a device without a graphics card goes with their number.
const FINE = 1 / 255, ROUGH = 1 / 64;
const TANGENT_MARGIN = 0.3;  // beyond the image's edge, as in clsplat/rendering/camera_block.py

// Returns the format of the image in which splats are blended. Processors blend 32 bits faster than 16.
function imageFormat(gl) {
  if (!gl.getExtension("EXT_color_buffer_float"))
    return gl.getExtension("EXT_color_buffer_half_float") ? gl.RGBA16F : gl.RGBA8;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  return /swiftshader|llvmpipe|software/i.test(name) && gl.getExtension("EXT_float_blend") ? gl.RGBA32F : gl.RGBA16F;
}

class Renderer {
  constructor(canvas, payload, shaders) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2. Update it, or switch hardware acceleration on.");
    Object.assign(this, { gl, canvas, payload, n: payload.head.splats });
    this.format = imageFormat(gl);
    this.exponential = payload.columns.beta ? 1 : 0;
    this.project = this.program(shaders["project.vert"], null, ["box", "place", "form", "lean", "rest"]);
    this.splat = this.program(shaders["splat.vert"], shaders["splat.frag"]);
    this.screen = this.program(shaders["screen.vert"], shaders["screen.frag"]);
    this.upload();
    this.makeBuffers();
    this.count = null;  // number of splats in the order; null before there is one
    this.size = [0, 0];
    this.cutoff = FINE;
    this.drawing = [];  // pictures that the device has not finished, the oldest first
    this.done = 0;      // time at which the last picture was done [ms]
  }

  // Notes a picture that was drawn. WebGL only takes orders: the device finishes it later, or much later.
  note(since, counts) {
    const gl = this.gl;
    this.drawing.push({ sync: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), since, counts });
  }

  // Forgets finished pictures. Returns how long each of those that count took [ms]; null if there are none.
  poll(now) {
    const gl = this.gl;
    const isDone = ({ sync }) => gl.getSyncParameter(sync, gl.SYNC_STATUS) === gl.SIGNALED;
    let finished = 0, counted = false;
    const begun = this.drawing.length ? Math.max(this.drawing[0].since, this.done) : now;
    while (this.drawing.length && isDone(this.drawing[0])) {
      const { sync, counts } = this.drawing.shift();
      gl.deleteSync(sync);
      counted = counts;
      finished += 1;
    }
    if (!finished) return null;
    this.done = now;
    return counted ? (now - begun) / finished : null;
  }

  program(vertex, fragment, outputs = null) {
    const gl = this.gl;
    const program = gl.createProgram();
    const empty = "#version 300 es\nprecision highp float; out vec4 c; void main() { c = vec4(0.0); }";
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment || empty]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
        throw new Error(`A shader does not compile here: ${gl.getShaderInfoLog(shader)}`);
      gl.attachShader(program, shader);
    }
    if (outputs) gl.transformFeedbackVaryings(program, outputs, gl.INTERLEAVED_ATTRIBS);
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`A program does not link here: ${gl.getProgramInfoLog(program)}`);
    const at = {};
    const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; ++i) {
      const { name } = gl.getActiveUniform(program, i);
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  // Makes the texture of texels with 3 or 4 floats, which `fill` writes into an array.
  texture(unit, count, floats, exact, fill) {
    const gl = this.gl;
    const height = Math.max(Math.ceil(count / TEXELS), 1);
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(this.tooMany());
    const values = new Float32Array(TEXELS * height * floats);
    fill(values);
    this.makeTexture(unit);
    const inside = floats === 4 ? gl.RGBA32F : exact ? gl.RGB32F : gl.RGB16F;
    const format = floats === 4 ? gl.RGBA : gl.RGB;
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, TEXELS, height, 0, format, gl.FLOAT, values);
  }

  // Makes an empty texture and binds it to a unit.
  makeTexture(unit) {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  tooMany() {
    return `${this.n} splats are too many for this graphics device. Prune the model: clsplat prune.`;
  }

  upload() {
    const { n } = this;
    const { columns, head } = this.payload;
    const bands = columns.harmonics ? columns.harmonics.length / n / 3 : 0;
    this.degree = Math.round(Math.sqrt(bands + 1)) - 1;
    // Four texels of a splat: mean and opacity, scale, rotation (w, x, y, z), skew and beta.
    this.texture(0, 4 * n, 4, true, (values) => {
      const { mean, opacity, log_scale: logScale, rotation, skew, beta } = columns;
      for (let i = 0; i < n; ++i) {
        const at = 16 * i;
        let square = 0;
        for (let c = 0; c < 3; ++c) {
          values[at + c] = mean[c * n + i];
          values[at + 4 + c] = Math.exp(logScale[c * n + i]);
          square += rotation[c * n + i] ** 2;
          if (skew) values[at + 12 + c] = skew[c * n + i];
        }
        values[at + 3] = opacity[i];
        if (beta) values[at + 15] = beta[i];
        values[at + 8] = (1 - square) / (1 + square);
        for (let c = 0; c < 3; ++c) values[at + 9 + c] = (2 * rotation[c * n + i]) / (1 + square);
      }
    });
    const exact = head.columns[0].map === "float";
    this.texture(1, n * (bands + 1), 3, exact, (values) => {
      for (let i = 0; i < n; ++i) {
        const at = 3 * (bands + 1) * i;
        for (let c = 0; c < 3; ++c) values[at + c] = columns.color[c * n + i];
        for (let k = 0; k < 3 * bands; ++k) values[at + 3 + k] = columns.harmonics[k * n + i];
      }
    });
  }

  makeBuffers() {
    const gl = this.gl;
    this.orderBuffer = gl.createBuffer();
    this.orderArray = gl.createVertexArray();
    gl.bindVertexArray(this.orderArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * this.n, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 4, 0);

    const rows = Math.max(Math.ceil(this.n / ROW), 1);
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(this.tooMany());
    this.projected = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.projected);
    gl.bufferData(gl.ARRAY_BUFFER, 16 * PARTS * ROW * rows, gl.DYNAMIC_COPY);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    this.makeTexture(3);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, PARTS * ROW, rows);

    // Two triangles for each splat of a batch. The last corner of both is the same: it alone has the flat values.
    const corners = new Uint16Array(6 * BATCH);
    for (let i = 0; i < BATCH; ++i) corners.set([0, 1, 3, 2, 0, 3].map((corner) => 4 * i + corner), 6 * i);
    this.splatArray = gl.createVertexArray();
    gl.bindVertexArray(this.splatArray);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.feedback = gl.createTransformFeedback();
  }

  // Sets the splats that are drawn, from far to near.
  setOrder(order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    this.count = order.length;
  }

  // Sets the size of the screen, and that of the image as a share of it [px].
  resize(screenWidth, screenHeight, share = 1) {
    this.cutoff = share < 1 ? ROUGH : FINE;
    const width = Math.max(Math.round(screenWidth * share), 1);
    const height = Math.max(Math.round(screenHeight * share), 1);
    if (this.canvas.width !== screenWidth) this.canvas.width = screenWidth;
    if (this.canvas.height !== screenHeight) this.canvas.height = screenHeight;
    if (this.size[0] === width && this.size[1] === height) return;
    const gl = this.gl;
    this.size = [width, height];
    gl.deleteTexture(this.image);
    gl.deleteFramebuffer(this.target);
    this.image = this.makeTexture(2);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
  }

  // Draws a view: {position, axes} and a lens for the size of the image, over a background of 0..1.
  draw(pose, lens, background) {
    const gl = this.gl;
    const [width, height] = this.size;
    if (this.count) this.projectSplats(pose, lens);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (this.count) {
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.useProgram(this.splat.program);
      gl.uniform2f(this.splat.at.size, width, height);
      gl.uniform1i(this.splat.at.projected, 3);
      gl.uniform1i(this.splat.at.splats, this.count);
      gl.uniform1i(this.splat.at.batch, BATCH);
      gl.uniform1i(this.splat.at.exponential, this.exponential);
      gl.uniform1f(this.splat.at.cutoff, this.cutoff);
      gl.bindVertexArray(this.splatArray);
      gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.count / BATCH));
      gl.disable(gl.BLEND);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.useProgram(this.screen.program);
    gl.uniform2f(this.screen.at.size, this.canvas.width, this.canvas.height);
    gl.uniform1i(this.screen.at.image, 2);
    gl.uniform3fv(this.screen.at.background, background);
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  projectSplats({ position, axes }, { fx, fy, cx, cy }) {
    const gl = this.gl;
    const [width, height] = this.size;
    const { program, at } = this.project;
    const { head } = this.payload;
    gl.useProgram(program);
    gl.uniform1i(at.geometry, 0);
    gl.uniform1i(at.colour, 1);
    gl.uniformMatrix3fv(at.rotation, true, axes.flat());
    gl.uniform3fv(at.translation, axes.map((axis) => -dot(axis, position)));
    gl.uniform3fv(at.eye, position);
    gl.uniform4f(at.lens, fx, fy, cx, cy);
    const x = (TANGENT_MARGIN * 0.5 * width) / fx;
    const y = (TANGENT_MARGIN * 0.5 * height) / fy;
    gl.uniform4f(at.bounds, -cx / fx - x, (width - cx) / fx + x, -cy / fy - y, (height - cy) / fy + y);
    gl.uniform2f(at.size, width, height);
    gl.uniform1f(at.near, head.near_plane);
    gl.uniform1f(at.lowPass, head.low_pass);
    gl.uniform1f(at.cutoff, this.cutoff);
    gl.uniform1i(at.normalisation, head.normalisation);
    gl.uniform1i(at.antialiased, head.antialiased ? 1 : 0);
    gl.uniform1i(at.degree, this.degree);
    gl.uniform1i(at.exponential, this.exponential);
    gl.bindVertexArray(this.orderArray);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.projected);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.count);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, this.projected);
    gl.activeTexture(gl.TEXTURE3);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, PARTS * ROW, Math.ceil(this.count / ROW), gl.RGBA, gl.FLOAT, 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
  }
}
