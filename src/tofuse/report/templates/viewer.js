"use strict";
(function () {
  const box = document.getElementById("viewer");
  const data = document.getElementById("scene");
  if (!box || !data) return;
  const canvas = box.querySelector("canvas");
  const gl = canvas.getContext("webgl", { antialias: true, alpha: false });
  if (!gl) { box.classList.add("without"); return; }

  const scene = JSON.parse(data.textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

  const POINTS = `
    attribute vec3 place, color, normal;
    attribute float value;
    uniform mat4 view, lens;
    uniform vec3 low, extent, eye;
    uniform float size, peel, shade, byValue, least, most;
    varying vec3 tint;
    vec3 ramp(float t) {
      vec3 a = vec3(.27, .0, .33), b = vec3(.13, .57, .55), c = vec3(.99, .91, .15);
      return t < .5 ? mix(a, b, t * 2.) : mix(b, c, t * 2. - 1.);
    }
    void main() {
      vec3 p = low + place * extent;
      vec4 v = view * vec4(p, 1.);
      gl_Position = lens * v;
      if (peel > .5 && dot(normal, eye - p) < 0.) gl_Position = vec4(2., 2., 2., 1.);
      gl_PointSize = clamp(size / max(-v.z, 1e-6), least, most);
      tint = byValue > .5 ? ramp(value) : mix(vec3(.14), vec3(1.), color);
      if (shade > .5) tint *= .6 + .4 * abs(dot(normal, normalize(eye - p)));
    }`;
  const LINES = `
    attribute vec3 place;
    uniform mat4 view, lens;
    void main() { gl_Position = lens * view * vec4(place, 1.); }`;
  const TINT = `precision mediump float; varying vec3 tint;
    void main() { gl_FragColor = vec4(tint, 1.); }`;
  const FLAT = `precision mediump float; uniform vec3 ink;
    void main() { gl_FragColor = vec4(ink, 1.); }`;

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
    return p;
  }
  function buffer(array) {
    const b = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, b);
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    return b;
  }
  let dots, wires;
  try { dots = program(POINTS, TINT); wires = program(LINES, FLAT); } catch (error) {
    box.classList.add("without");
    return;
  }
  const buffers = {
    place: buffer(bytes(scene.points)),
    color: buffer(bytes(scene.colors)),
    normal: scene.normals ? buffer(bytes(scene.normals)) : null,
  };
  // More than 65536 vertices need an extension, which all but very old browsers have.
  const wide = gl.getExtension("OES_element_index_uint");
  const mesh = scene.mesh && wide ? {
    place: buffer(bytes(scene.mesh.points)),
    color: buffer(bytes(scene.mesh.colors)),
    normal: buffer(bytes(scene.mesh.normals)),
    faces: gl.createBuffer(),
    count: 0,
  } : null;
  if (mesh) {
    const raw = bytes(scene.mesh.faces);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.faces);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, raw, gl.STATIC_DRAW);
    mesh.count = raw.length / 4;
  }
  // Several views in several states: each layer is drawn in one state, where its view is switched on.
  const arrays = {};
  for (const name in scene.arrays || {}) arrays[name] = buffer(bytes(scene.arrays[name]));
  const layers = (scene.layers || []).map((layer) => ({
    ...layer,
    place: arrays[layer.points],
    color: layer.colors ? arrays[layer.colors] : null,
    ink: layer.color.map((value) => value / 255),
    normal: layer.normals ? arrays[layer.normals] : null,
  }));
  const mode = () => { const input = box.querySelector("[name=mode]:checked"); return input ? input.value : ""; };
  const fields = {};
  for (const name in scene.fields || {}) {
    const { points, vertices } = scene.fields[name];
    fields[name] = { points: buffer(bytes(points)), vertices: buffer(bytes(vertices)) };
  }
  const by = () => { const input = box.querySelector("[name=by]"); return input ? input.value : ""; };
  function label() {
    const bar = box.querySelector(".bar"), field = (scene.fields || {})[by()];
    if (!bar) return;
    bar.hidden = !field;
    if (field) bar.querySelectorAll("span").forEach((end, k) => { end.textContent = field.said[k]; });
  }
  const lines = {};
  for (const name in scene.lines) {
    const raw = bytes(scene.lines[name]);
    lines[name] = { buffer: buffer(raw), count: raw.length / 12 };
  }
  // The camera of the frame that is chosen further down, drawn larger than the others.
  lines.chosen = { buffer: buffer(new Float32Array(48)), count: 0 };
  document.addEventListener("frame-chosen", (e) => {
    const T = e.detail;
    lines.chosen.count = 0;
    if (T) {
      const s = 0.035 * scene.size, corners = [[-.5, -.4], [.5, -.4], [.5, .4], [-.5, .4]];
      const at = (x, y, z) => [0, 4, 8].map((k) => T[k] * x + T[k + 1] * y + T[k + 2] * z + T[k + 3]);
      const tip = at(0, 0, 0), ends = corners.map(([x, y]) => at(x * s, y * s, .8 * s));
      const all = ends.flatMap((end, k) => [...tip, ...end, ...end, ...ends[(k + 1) % 4]]);
      gl.bindBuffer(gl.ARRAY_BUFFER, lines.chosen.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(all), gl.DYNAMIC_DRAW);
      lines.chosen.count = 16;
    }
    draw();
  });
  const inks = {
    chosen: [1, 0.88, 0.35],
    before: [0.94, 0.63, 0.24], after: [0.35, 0.69, 0.96],
    reference: [0.92, 0.92, 0.92], loops: [0.37, 0.85, 0.55],
  };

  const start = { yaw: scene.yaw, pitch: scene.pitch, distance: 1.2 * scene.size, target: scene.center };
  const eye = {};
  // What is to be seen: an outline of what is shown, else the corners of a box.
  function framed() {
    if (scene.outlines) return scene.outlines[mode()];
    const corners = [];
    for (let k = 0; k < 8; k++) corners.push([0, 1, 2].map((axis) => scene.box[(k >> axis) & 1][axis]));
    return corners;
  }
  function reset(changes) {
    Object.assign(eye, start, { target: start.target.slice() }, changes || {});
    if (scene.outlines) {
      const seen = framed();
      eye.target = [0, 1, 2].map((axis) => seen.reduce((sum, point) => sum + point[axis] / seen.length, 0));
    }
    fit();
    draw();
  }
  // Half the height that is seen at depth 1; less of a canvas that is narrow.
  const lens = () => {
    const aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    const f = Math.min(1, aspect / 1.2) / Math.tan(0.35);
    return [f / aspect, f];
  };
  // Moves the eye until the box fills the canvas, all but a border.
  function fit() {
    const R = turn(), f = lens(), corners = framed();
    for (let round = 0; round < 8; round++) {
      let fill = 0;
      for (let k = 0; k < 2; k++) {
        const seen = corners.map((corner) => {
          const from = corner.map((value, axis) => value - eye.target[axis]);
          return f[k] * dot(R[k], from) / Math.max(dot(R[2], from) + eye.distance, 0.05 * scene.size);
        });
        const low = Math.min(...seen), high = Math.max(...seen);
        fill = Math.max(fill, (high - low) / 2);
        const step = (low + high) / 2 * eye.distance / f[k];
        for (let axis = 0; axis < 3; axis++) eye.target[axis] += step * R[k][axis];
      }
      eye.distance = Math.max(0.3 * scene.size, eye.distance * (1 + fill / 0.85) / 2);
    }
  }

  // The world is x right, y down, z forward; rows of the turn into such a view.
  function turn() {
    const cy = Math.cos(eye.yaw), sy = Math.sin(eye.yaw), cp = Math.cos(eye.pitch), sp = Math.sin(eye.pitch);
    return [[cy, 0, sy], [sp * sy, cp, -sp * cy], [-cp * sy, sp, cp * cy]];
  }
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const on = (name) => { const input = box.querySelector(`[name=${name}]`); return Boolean(input && input.checked); };

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; paint(); });
  }
  function paint() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(22 / 255, 25 / 255, 30 / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);

    const R = turn();
    const t = R.map((row) => -dot(row, eye.target));
    t[2] += eye.distance;
    // OpenGL looks along -z with y up: the second and third rows change sign.
    const view = new Float32Array([
      R[0][0], -R[1][0], -R[2][0], 0, R[0][1], -R[1][1], -R[2][1], 0,
      R[0][2], -R[1][2], -R[2][2], 0, t[0], -t[1], -t[2], 1]);
    const [fx, fy] = lens(), near = 0.01 * eye.distance, far = eye.distance + 50 * scene.size;
    const projection = new Float32Array([
      fx, 0, 0, 0, 0, fy, 0, 0,
      0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]);
    const at = [0, 1, 2].map((k) => eye.target[k] - R[2][k] * eye.distance);

    const surface = on("mesh") && mesh;
    const shown = layers.filter((layer) => layer.mode === mode() && on(layer.view));
    if ((on("points") && scene.count) || surface || shown.length) {
      gl.useProgram(dots);
      const u = (name) => gl.getUniformLocation(dots, name);
      gl.uniformMatrix4fv(u("view"), false, view);
      gl.uniformMatrix4fv(u("lens"), false, projection);
      gl.uniform3fv(u("low"), scene.low);
      gl.uniform3fv(u("extent"), scene.extent);
      gl.uniform3fv(u("eye"), at);
      gl.uniform1f(u("size"), 1.5 * scene.spacing * fy * height / 2);
      gl.uniform1f(u("least"), layers.length ? 2 * ratio : 1);
      gl.uniform1f(u("most"), 10 * ratio);
      const values = fields[by()];
      const use = (set, value) => {
        gl.uniform1f(u("byValue"), value ? 1 : 0);
        if (value) attribute(dots, "value", value, gl.UNSIGNED_BYTE, true, 1);
        gl.uniform1f(u("shade"), set.normal ? 1 : 0);
        attribute(dots, "place", set.place, gl.UNSIGNED_SHORT, true);
        if (set.color) attribute(dots, "color", set.color, gl.UNSIGNED_BYTE, true);
        else plain(dots, "color", set.ink);
        if (set.normal) attribute(dots, "normal", set.normal, gl.BYTE, true);
      };
      if (surface) {
        gl.uniform1f(u("peel"), 0);
        if (on("peel")) gl.enable(gl.CULL_FACE);
        use(mesh, values && values.vertices);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.faces);
        gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
        gl.disable(gl.CULL_FACE);
      }
      if (on("points") && scene.count) {
        gl.uniform1f(u("peel"), on("peel") && buffers.normal ? 1 : 0);
        use(buffers, values && values.points);
        gl.drawArrays(gl.POINTS, 0, scene.count);
      }
      for (const layer of shown) {
        gl.uniform1f(u("peel"), 0);
        gl.uniform3fv(u("low"), layer.low);
        gl.uniform3fv(u("extent"), layer.extent);
        gl.uniform1f(u("size"), 1.5 * layer.spacing * fy * height / 2);
        if (!layer.normal) plain(dots, "normal", [0, 0, 1]);
        use(layer);
        gl.drawArrays(gl.POINTS, 0, layer.count);
      }
      for (const name of ["color", "normal", "value"]) {
        const place = gl.getAttribLocation(dots, name);
        if (place >= 0) gl.disableVertexAttribArray(place);
      }
    }
    gl.useProgram(wires);
    gl.uniformMatrix4fv(gl.getUniformLocation(wires, "view"), false, view);
    gl.uniformMatrix4fv(gl.getUniformLocation(wires, "lens"), false, projection);
    for (const name in lines) {
      if (!lines[name].count || !(name === "chosen" || on(name))) continue;
      gl.uniform3fv(gl.getUniformLocation(wires, "ink"), inks[name]);
      attribute(wires, "place", lines[name].buffer, gl.FLOAT, false);
      gl.drawArrays(gl.LINES, 0, lines[name].count);
    }
  }
  function attribute(of, name, source, type, scaled, numbers = 3) {
    const place = gl.getAttribLocation(of, name);
    if (place < 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, source);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, numbers, type, scaled, 0, 0);
  }

  function plain(of, name, value) {
    const place = gl.getAttribLocation(of, name);
    if (place < 0) return;
    gl.disableVertexAttribArray(place);
    gl.vertexAttrib3fv(place, value);
  }

  function orbit(dx, dy) {
    eye.yaw -= dx * 0.006;
    eye.pitch = Math.max(-1.57, Math.min(1.57, eye.pitch + dy * 0.006));
    draw();
  }
  function pan(dx, dy) {
    const R = turn(), step = 2 * eye.distance * Math.tan(0.35) / canvas.clientHeight;
    for (let k = 0; k < 3; k++) eye.target[k] -= step * (dx * R[0][k] + dy * R[1][k]);
    draw();
  }
  function zoom(factor) {
    eye.distance = Math.max(0.005 * scene.size, Math.min(20 * scene.size, eye.distance * factor));
    draw();
  }

  const fingers = new Map();
  const middle = () => {
    const [a, b] = [...fingers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, span: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    canvas.focus({ preventScroll: true });
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    e.preventDefault();
  });
  canvas.addEventListener("pointermove", (e) => {
    const last = fingers.get(e.pointerId);
    if (!last) return;
    const now = { x: e.clientX, y: e.clientY };
    if (fingers.size === 1) {
      const move = e.shiftKey || e.buttons & 6 ? pan : orbit;
      move(now.x - last.x, now.y - last.y);
      fingers.set(e.pointerId, now);
    } else if (fingers.size === 2) {
      const old = middle();
      fingers.set(e.pointerId, now);
      const fresh = middle();
      pan(fresh.x - old.x, fresh.y - old.y);
      if (fresh.span > 0) zoom(old.span / fresh.span);
    }
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
  }
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("dblclick", () => reset());
  canvas.addEventListener("wheel", (e) => {
    if (document.activeElement !== canvas && !e.ctrlKey) return;  // the page scrolls on
    e.preventDefault();
    zoom(Math.exp(Math.max(-60, Math.min(60, e.deltaMode ? 20 * e.deltaY : e.deltaY)) * 0.002));
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const move = e.shiftKey ? pan : orbit, step = 20;
    const keys = {
      ArrowLeft: () => move(-step, 0), ArrowRight: () => move(step, 0),
      ArrowUp: () => move(0, -step), ArrowDown: () => move(0, step),
      "+": () => zoom(0.85), "=": () => zoom(0.85), "-": () => zoom(1.18), 0: () => reset(),
    };
    if (!keys[e.key] || e.ctrlKey || e.metaKey) return;
    keys[e.key]();
    e.preventDefault();
  });
  const views = {
    above: { yaw: 0, pitch: 1.57 }, side: { yaw: 1.5708, pitch: 0 }, front: { yaw: 0, pitch: 0 }, start: {},
  };
  box.addEventListener("click", (e) => {
    const button = e.target.closest("button");
    if (!button) return;
    if (button.dataset.view) reset(views[button.dataset.view]);
    if (button.dataset.zoom) zoom(Number(button.dataset.zoom));
  });
  let last = framed();
  box.addEventListener("change", () => {
    box.dataset.mode = mode();
    label();
    if (String(framed()) === String(last)) { draw(); return; }
    last = framed();
    reset();
  });
  canvas.addEventListener("webglcontextlost", () => box.classList.replace("live", "without"));
  new ResizeObserver(draw).observe(canvas);
  box.classList.add("live");
  label();
  reset();
})();

(function () {
  // The images of frames: a slider over time, and the strip above it.
  const strip = document.getElementById("strip");
  const said = document.getElementById("strip-said");
  const player = document.getElementById("player");
  const data = document.getElementById("pictures");
  let show = () => {};
  if (player && data) {
    const frames = JSON.parse(data.textContent);
    const slider = document.getElementById("frame");
    const words = document.getElementById("frame-said");
    const last = frames.index.length - 1;
    show = (row) => {
      row = Math.max(0, Math.min(last, row));
      slider.value = String(row);
      words.textContent = frames.told[row];
      words.className = frames.status[row];
      for (const image of player.querySelectorAll("img")) image.src = frames.images[image.dataset.kind][row];
      document.dispatchEvent(new CustomEvent("frame-chosen", { detail: frames.poses[row] }));
    };
    const here = () => Number(slider.value);
    slider.addEventListener("input", () => show(here()));
    player.addEventListener("click", (e) => {
      const button = e.target.closest("button");
      if (!button) return;
      if (button.dataset.step) show(here() + Number(button.dataset.step));
      if (button.dataset.bad) {
        for (let k = 1; k <= last + 1; k++) {
          const row = (here() + k) % (last + 1);
          if (frames.status[row] !== "tracked") { show(row); return; }
        }
      }
    });
    const bad = player.querySelector("[data-bad]");
    bad.hidden = frames.status.every((status) => status === "tracked");
    strip.addEventListener("click", (e) => {
      const cell = e.target.closest("rect");
      if (!cell) return;
      const index = Number(cell.dataset.frame);
      let best = 0;
      for (let k = 0; k <= last; k++) {
        if (Math.abs(frames.index[k] - index) < Math.abs(frames.index[best] - index)) best = k;
      }
      show(best);
    });
    player.classList.add("live");
    show(0);
  }
  // What is said of a frame on hover can also be tapped.
  if (!strip || !said) return;
  const tell = (e) => {
    const title = e.target.querySelector && e.target.closest("rect") && e.target.querySelector("title");
    if (title) said.textContent = title.textContent;
  };
  strip.addEventListener("pointerover", tell);
  strip.addEventListener("click", tell);
})();
