// Draws points, surfaces and lines by WebGL 1.
const MODEL = `
  attribute vec3 place, color, normal;
  attribute float value;
  attribute vec2 uv;
  uniform mat4 view, lens;
  uniform vec3 low, extent, eye;
  uniform vec2 ends;
  uniform float size, peel, shade, byValue, painted, least, most;
  varying vec3 tint, world;
  varying vec2 at;
  varying float depth, kept;
  // Viridis (van der Walt and Smith), by a polynomial.
  vec3 ramp(float t) {
    return vec3(.2777, .0054, .3341) + t * (vec3(.1051, 1.4046, 1.3846) + t * (vec3(-.3309, .2148, .0951)
      + t * (vec3(-4.6342, -5.7991, -19.3324) + t * (vec3(6.2283, 14.1799, 56.6906)
      + t * (vec3(4.7764, -13.7451, -65.3530) + t * vec3(-5.4355, 4.6459, 26.3124))))));
  }
  void main() {
    vec3 p = low + place * extent;
    vec4 v = view * vec4(p, 1.);
    gl_Position = lens * v;
    if (peel > .5 && dot(normal, eye - p) < 0.) gl_Position = vec4(2., 2., 2., 1.);
    gl_PointSize = clamp(size / max(-v.z, 1e-6), least, most);
    world = p;
    depth = -v.z;
    kept = value;
    at = uv;
    // Colours that stand for values are shown as they are in the bar; others are lit from the eye.
    if (byValue > .5) tint = clamp(ramp(clamp((value - ends.x) / (ends.y - ends.x), 0., 1.)), 0., 1.);
    else {
      tint = color;
      if (shade > .5 && painted < .5) {
        float facing = abs(dot(normal, normalize(eye - p))), above = .5 - .5 * normal.y;
        tint = color * (.34 + .52 * facing + .22 * above) + .03;
      }
    }
  }`;
const CLIP = `
  varying vec3 tint, world;
  varying float depth, kept;
  uniform vec3 from, to;
  void clip() { if (any(lessThan(world, from)) || any(greaterThan(world, to))) discard; }`;
// A texture has the light of the scene in it, and is not lit again.
const TINT = `precision highp float; ${CLIP}
  varying vec2 at;
  uniform float painted, byValue;
  uniform sampler2D picture;
  void main() {
    clip();
    gl_FragColor = vec4(painted > .5 && byValue < .5 ? texture2D(picture, at).rgb : tint, 1.);
  }`;
// Depth in 24 bits and the value in 8, to read what lies below a pixel.
const PROBE = `precision highp float; ${CLIP}
  uniform float far;
  void main() {
    clip();
    vec3 part = fract(clamp(depth / far, 0., .999999) * vec3(1., 255., 65025.));
    gl_FragColor = vec4(part - part.yzz * vec3(1. / 255., 1. / 255., 0.), kept);
  }`;
const LINES = `
  attribute vec3 place;
  attribute vec3 color;
  uniform mat4 view, lens;
  uniform float nearer;
  varying vec3 ink;
  void main() { ink = color; gl_Position = lens * view * vec4(place, 1.); gl_Position.z -= nearer * gl_Position.w; }`;
const INK = `precision mediump float; varying vec3 ink; void main() { gl_FragColor = vec4(ink, 1.); }`;

function makePainter(canvas, scene) {
  const gl = canvas.getContext("webgl", { antialias: false, alpha: false });
  if (!gl || typeof DecompressionStream === "undefined") return null;
  // More than 65536 vertices need an extension, which all but very old browsers have.
  if (!gl.getExtension("OES_element_index_uint")) return null;

  function program(vertex, fragment) {
    const p = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const s = gl.createShader(kind);
      gl.shaderSource(s, text);
      gl.compileShader(s);
      gl.attachShader(p, s);
    }
    gl.linkProgram(p);
    if (!gl.getProgramParameter(p, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(p));
    const uniforms = {}, attributes = {};
    for (let k = 0; k < gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(p, k);
      uniforms[name] = gl.getUniformLocation(p, name);
    }
    for (let k = 0; k < gl.getProgramParameter(p, gl.ACTIVE_ATTRIBUTES); k++) {
      const { name } = gl.getActiveAttrib(p, k);
      attributes[name] = gl.getAttribLocation(p, name);
    }
    return { p, uniforms, attributes };
  }
  let tint, probe, wires;
  try {
    tint = program(MODEL, TINT);
    probe = program(MODEL, PROBE);
    wires = program(LINES, INK);
  } catch (error) { return null; }

  function buffer(array, target = gl.ARRAY_BUFFER, use = gl.STATIC_DRAW) {
    const b = gl.createBuffer();
    gl.bindBuffer(target, b);
    gl.bufferData(target, array, use);
    return b;
  }
  // A texture of an image's address; null where the browser can't take it.
  async function picture(source) {
    const image = new Image();
    image.src = source;
    try { await image.decode(); } catch (error) { return null; }
    if (image.width > gl.getParameter(gl.MAX_TEXTURE_SIZE)) return null;
    const made = gl.createTexture(), whole = (n) => (n & (n - 1)) === 0;
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
    const mipmaps = whole(image.width) && whole(image.height);
    if (mipmaps) gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, mipmaps ? gl.LINEAR_MIPMAP_LINEAR : gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return made;
  }
  const indices = (array) => buffer(array, gl.ELEMENT_ARRAY_BUFFER);
  function attribute(of, name, source, type, scaled, numbers = 3) {
    const at = of.attributes[name];
    if (at === undefined) return;
    if (!source || Array.isArray(source)) {
      gl.disableVertexAttribArray(at);
      if (numbers < 3) gl.vertexAttrib2f(at, 0, 0); else gl.vertexAttrib3fv(at, source || [0, 0, 1]);
      return;
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, source);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, numbers, type, scaled, 0, 0);
  }

  // Sizes the canvas: at rest for smooth edges, and by `scale` while it moves.
  function begin(scale, fine) {
    const ratio = fine ? 2 : Math.min(window.devicePixelRatio || 1, 2) * scale;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(29 / 255, 33 / 255, 40 / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    return ratio;
  }

  // Draws sets {place, color, normal, value, ends, faces, count, low, extent, spacing} as seen by a view.
  function model(sets, view, section, { ratio, peel, probing }) {
    const of = probing ? probe : tint, u = of.uniforms, m = view.matrices();
    gl.useProgram(of.p);
    gl.uniformMatrix4fv(u.view, false, m.view);
    gl.uniformMatrix4fv(u.lens, false, m.projection);
    gl.uniform3fv(u.eye, view.place());
    gl.uniform3fv(u.from, section.from);
    gl.uniform3fv(u.to, section.to);
    gl.uniform1f(u.least, 1);
    gl.uniform1f(u.most, 10 * ratio);
    if (probing) gl.uniform1f(u.far, m.far);
    for (const set of sets) {
      gl.uniform3fv(u.low, set.low);
      gl.uniform3fv(u.extent, set.extent);
      gl.uniform1f(u.size, 1.5 * set.spacing * view.lens()[1] * canvas.height / 2);
      gl.uniform1f(u.byValue, set.value && !probing ? 1 : 0);
      gl.uniform2fv(u.ends, set.ends || [0, 1]);
      gl.uniform1f(u.shade, set.normal ? 1 : 0);
      gl.uniform1f(u.painted, set.picture && set.uv && !probing ? 1 : 0);
      if (set.picture) gl.bindTexture(gl.TEXTURE_2D, set.picture);
      attribute(of, "uv", set.uv, gl.UNSIGNED_SHORT, true, 2);
      gl.uniform1f(u.peel, !set.faces && peel && set.normal ? 1 : 0);
      attribute(of, "value", set.value, gl.UNSIGNED_BYTE, true, 1);
      attribute(of, "place", set.place, gl.UNSIGNED_SHORT, true);
      attribute(of, "color", set.color, gl.UNSIGNED_BYTE, true);
      attribute(of, "normal", set.normal, gl.BYTE, true);
      if (set.faces) {
        if (peel) gl.enable(gl.CULL_FACE);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, set.faces);
        gl.drawElements(gl.TRIANGLES, probing ? set.measured ?? set.count : set.count, gl.UNSIGNED_INT, 0);
        gl.disable(gl.CULL_FACE);
      } else gl.drawArrays(gl.POINTS, 0, set.count);
    }
    for (const at of Object.values(of.attributes)) gl.disableVertexAttribArray(at);
  }

  // Draws sets {place, color, count, over} of lines; color is a buffer or one ink.
  function lines(sets, view) {
    const m = view.matrices(), u = wires.uniforms;
    gl.useProgram(wires.p);
    gl.uniformMatrix4fv(u.view, false, m.view);
    gl.uniformMatrix4fv(u.lens, false, m.projection);
    for (const set of sets) {
      if (!set.count) continue;
      gl.uniform1f(u.nearer, set.over || 0);
      attribute(wires, "place", set.place, gl.FLOAT, false);
      attribute(wires, "color", set.color, gl.UNSIGNED_BYTE, true);
      gl.drawArrays(gl.LINES, 0, set.count);
    }
    for (const at of Object.values(wires.attributes)) gl.disableVertexAttribArray(at);
  }

  // What lies below a pixel: its depth and its value, or null. Looks at the neighbours too.
  const N = 7, target = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, target);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, N, N, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, gl.getParameter(gl.TEXTURE_BINDING_2D), 0);
  gl.bindRenderbuffer(gl.RENDERBUFFER, gl.createRenderbuffer());
  gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT16, N, N);
  gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, gl.getParameter(gl.RENDERBUFFER_BINDING));
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.bindTexture(gl.TEXTURE_2D, null);

  function read(sets, view, section, x, y, options) {
    const ratio = canvas.width / canvas.clientWidth, data = new Uint8Array(4 * N * N), half = (N - 1) / 2;
    const left = Math.round(x * ratio) - half, bottom = canvas.height - 1 - Math.round(y * ratio) - half;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(-left, -bottom, canvas.width, canvas.height);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    model(sets, view, section, { ...options, ratio, probing: true });
    gl.readPixels(0, 0, N, N, gl.RGBA, gl.UNSIGNED_BYTE, data);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const { far } = view.matrices();
    let best = null;
    for (let k = 0; k < N * N; k++) {
      const [a, b, c, d] = data.subarray(4 * k, 4 * k + 4);
      const share = a / 255 + b / 65025 + c / 16581375;
      if (share > 0.99) continue;
      const off = Math.hypot((k % N) - half, Math.floor(k / N) - half);
      if (!best || off < best.off) best = { off, depth: share * far, value: d };
    }
    return best;
  }
  return { gl, buffer, indices, picture, begin, model, lines, read };
}
