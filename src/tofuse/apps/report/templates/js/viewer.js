// The 3D view: what is shown, in which colours, and its tools.
async function startViewer(box, scene, bus) {
  const canvas = box.querySelector("canvas");
  const painter = makePainter(canvas, scene);
  if (!painter) { box.classList.add("without"); return; }
  const buffered = async (text, Kind, columns) => (text ? painter.buffer(await unpack(text, Kind, columns)) : null);

  // The model, once as a surface and once as points; and the surface with fewer triangles.
  const base = { low: scene.low, extent: scene.extent, spacing: scene.spacing };
  let surface = null, points = null;
  const coarse = [];
  if (scene.model) {
    const place = await unpack(scene.model.points, Uint16Array, 3);
    const shared = {
      ...base, place: painter.buffer(place), color: await buffered(scene.model.colors, Uint8Array, 3),
      normal: await buffered(scene.model.normals, Int8Array, 3),
    };
    points = { ...shared, count: scene.count };
    if (scene.model.faces) {
      const faces = await unpack(scene.model.faces, Uint32Array, 3);
      surface = { ...shared, faces: painter.indices(faces), count: faces.length, measured: faces.length - 3 * scene.model.filled };
      for (const most of COARSE) {
        const fewer = faces.length > 3 * most ? clustered(place, faces, scene.extent, most) : faces;
        coarse.push({ ...shared, merged: fewer !== faces, faces: painter.indices(fewer), count: fewer.length });
      }
    }
  }
  const fields = {};
  for (const name in scene.fields || {}) {
    fields[name] = { ...scene.fields[name], values: await buffered(scene.fields[name].values, Uint8Array, 1) };
  }
  const lines = {};
  const inks = { reference: [0.85, 0.86, 0.88], loops: [0.37, 0.85, 0.55] };
  for (const name in scene.lines) {
    const raw = await unpack(scene.lines[name], Float32Array, 3);
    lines[name] = { place: painter.buffer(raw), color: inks[name], count: raw.length / 3 };
  }
  let cameras = null, frames = null;
  if (scene.frames) {
    const { index, status, errors, after, before, rig } = scene.frames;
    frames = {
      index: await unpack(index, Uint32Array, 1), status,
      errors: errors ? await unpack(errors, Uint8Array, 1) : null,
      rig: rig && { colors: rig.colors, of: await unpack(rig.of, Uint8Array, 1) },
      after: await unpack(after, Float32Array, 12), before: await unpack(before, Float32Array, 12),
    };
    cameras = makeCameras(painter, scene.size, frames);
    makeTimeline(box, frames, fields.accuracy && shown(fields.accuracy), bus);
  }

  const chosenOf = (name) => { const input = box.querySelector(`[name=${name}]`); return input ? input.value : ""; };
  const on = (name) => { const input = box.querySelector(`[name=${name}]`); return input ? input.checked : Boolean(ALONE[name]); };
  const view = makeEye(canvas, scene, draw);
  const section = makeSection(box, scene, draw);
  const sigmaOf = (value) => {
    const field = fields.accuracy;
    return field ? field.span[0] * (field.span[1] / field.span[0]) ** (value / 255) : null;
  };
  const lengths = scene.lengths && (await makeLengths(scene.lengths));
  const measure = box.querySelector("[data-tool=measure]") ? makeMeasure(box, view, painter, { sigmaOf, axes: scene.axes, lengths, changed: draw }) : null;
  const overlay = makeOverlay(box, view, draw);
  let marked = null;

  // What is drawn of the model now, as sets for the painter.
  function sets(detail, probing) {
    const field = fields[probing ? "accuracy" : chosenOf("by")];
    const dressed = (set) => ({ ...set, value: field ? field.values : null, ends: field ? field.ends : null });
    const out = [];
    if (surface && on("mesh")) out.push(dressed(detail ? coarse[detail - 1] : surface));
    if (points && on("points") && !(surface && !box.querySelector("[name=points]"))) out.push(dressed(points));
    return out;
  }
  const options = () => ({ peel: on("peel") });

  // While it moves, a machine that can't keep up draws fewer triangles and fewer pixels. Once the
  // view rests all of them are drawn, and more pixels than are seen, for smooth edges.
  let waiting = false, resting = 0, last = 0, effort = 0;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame((now) => {
      waiting = false;
      const gap = now - last;
      last = now;
      if (gap < 400) effort = Math.max(0, Math.min(4, effort + (gap > 25 ? 1 : gap < 18 ? -0.05 : 0)));
      const [detail, scale] = EFFORTS[Math.floor(effort)];
      paint(detail, scale);
      clearTimeout(resting);
      resting = setTimeout(() => requestAnimationFrame(() => paint(0, 1, true)), 200);
    });
  }
  function paint(detail, scale, fine) {
    const ratio = painter.begin(scale, fine);
    const model = sets(detail, false);
    if (model.length) painter.model(model, view, section, { ratio, ...options() });
    const wires = Object.keys(lines).filter(on).map((name) => lines[name]);
    if (cameras && !view.through) {  // in the way of who looks through one of them
      if (on("before")) wires.push(cameras.earlier);
      if (on("after")) wires.push(cameras.now, cameras.chosen);
    }
    if (measure) { wires.push(measure.line); measure.place(); }
    painter.lines(wires, view);
    overlay.place();
  }

  const START = { yaw: scene.yaw, pitch: scene.pitch };
  const views = {
    above: { yaw: 0, pitch: 1.57 }, side: { yaw: 1.5708, pitch: 0 }, front: { yaw: 0, pitch: 0 }, start: START,
  };
  const reset = () => view.flyTo(START, scene.framed);

  function recolor() {
    const bar = box.querySelector(".bar"), field = fields[chosenOf("by")];
    if (bar) {
      bar.hidden = !field;
      if (field) {
        bar.querySelector("strong").textContent = field.label;
        bar.querySelectorAll("span").forEach((tick, k) => { tick.textContent = field.labels[k]; });
      }
    }
    if (!cameras) return;
    const accuracy = chosenOf("by") === "accuracy" ? fields.accuracy : null;
    cameras.paint(accuracy && shown(accuracy), marked);
  }

  // Frames that are spoken of elsewhere on the page: their cameras are shown.
  function reveal() {
    const input = box.querySelector("[name=after]");
    if (input) input.checked = true;
  }
  bus.addEventListener("chosen", (e) => {
    if (!cameras) return;
    reveal();
    const row = rowOf(e.detail.index), T = cameras.pose(row);
    cameras.choose(row);
    if (view.through && T) view.lookThrough(T); else draw();
  });
  bus.addEventListener("pictured", draw);
  bus.addEventListener("marked", (e) => {
    if (!cameras) return;
    const { ranges } = e.detail;
    if (ranges.length) reveal();
    marked = ranges.length ? (row) => ranges.some(([a, b]) => frames.index[row] >= a && frames.index[row] <= b) : null;
    recolor();
    const seen = marked ? cameras.centres(marked) : [];
    if (seen.length) {
      // Around the cameras, with what they stand in front of.
      const low = [0, 1, 2].map((k) => Math.min(...seen.map((p) => p[k]))), high = [0, 1, 2].map((k) => Math.max(...seen.map((p) => p[k])));
      const room = 0.12 * scene.size;
      const corners = Array.from({ length: 8 }, (_, k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high[axis] + room : low[axis] - room)));
      view.flyTo(START, corners, 0.25 * scene.size);
    } else if (!marked) reset();
    draw();
  });
  bus.addEventListener("through", (e) => {
    const T = cameras && cameras.pose(rowOf(e.detail.index));
    if (view.through) reset(); else if (T) view.lookThrough(T);
  });
  function rowOf(index) {
    let low = 0, high = frames.index.length - 1;
    while (low < high) {
      const half = (low + high) >> 1;
      if (frames.index[half] < index) low = half + 1; else high = half;
    }
    return frames.index[low] === index ? low : -1;
  }

  function tap(x, y) {
    if (measure && measure.on) {
      const found = painter.read(sets(0, true), view, section, x, y, options());
      draw();
      if (found) measure.add(view.behind(x, y, found.depth), found.value); else measure.miss();
      return;
    }
    const row = cameras && on("after") ? cameras.near(view, x, y) : -1;
    if (row >= 0) bus.dispatchEvent(new CustomEvent("chosen", { detail: { index: frames.index[row], shown: true } }));
  }
  listen(canvas, view, { reset, tap });

  function shoot() {
    paint(0, 1, true);
    const picture = document.createElement("canvas"), pen = picture.getContext("2d");
    picture.width = canvas.width;
    picture.height = canvas.height;
    pen.drawImage(canvas, 0, 0);
    captions(pen, box, canvas);
    picture.toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = "model.png";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }
  async function fill() {
    const full = !box.classList.contains("whole");
    box.classList.toggle("whole", full);
    document.body.classList.toggle("covered", full);
    box.querySelector("[data-tool=full]").setAttribute("aria-pressed", String(full));
    try {  // phones that refuse it still show the view on the whole page
      if (full && box.requestFullscreen) await box.requestFullscreen();
      else if (!full && document.fullscreenElement) await document.exitFullscreen();
    } catch (error) { /* refused */ }
  }
  document.addEventListener("fullscreenchange", () => {
    if (!document.fullscreenElement && box.classList.contains("whole")) fill();
  });
  document.addEventListener("keydown", (e) => {
    if (e.key !== "Escape") return;
    if (measure && measure.on) measure.toggle(false);
    else if (box.classList.contains("whole")) fill();
  });
  box.addEventListener("click", (e) => {
    const button = e.target.closest("button");
    if (!button) return;
    const { view: from, zoom, tool } = button.dataset;
    if (from) view.flyTo(views[from], scene.framed);
    if (zoom) view.zoom(Number(zoom));
    if (tool === "shot") shoot();
    if (tool === "full") fill();
    if (tool === "section") {
      const panel = box.querySelector(".section");
      panel.hidden = !panel.hidden;
      button.setAttribute("aria-pressed", String(!panel.hidden));
    }
  });
  box.addEventListener("change", (e) => {
    if (e.target.name === "by") recolor();
    draw();
  });
  canvas.addEventListener("webglcontextlost", () => box.classList.replace("live", "without"));
  box.classList.add("live");
  recolor();
  view.look(START, scene.framed);
  new ResizeObserver(draw).observe(canvas);

  // Until the texture is decoded, which takes a while, the surface has the colours of its vertices.
  // Merged vertices, which are in several charts of the texture, keep theirs.
  const picture = surface && scene.model.texture ? await painter.picture(scene.model.texture) : null;
  if (!picture) return;
  const uv = await buffered(scene.model.uv, Uint16Array, 2);
  for (const set of [surface, ...coarse]) if (!set.merged) Object.assign(set, { picture, uv });
  draw();
}

// What a page without switches shows; points where there is no surface.
const ALONE = { mesh: true, points: true, peel: true };
const COARSE = [60000, 20000];  // triangles of a surface that moves, where all of them are too many
const EFFORTS = [[0, 1], [1, 1], [1, 0.75], [2, 0.75], [2, 0.5]];  // which of them, and how many pixels

// Fewer triangles over the same vertices: those of one cell become the first of them.
function clustered(place, faces, extent, most) {
  const longest = Math.max(...extent), n = place.length / 3;
  const area = faces.length / 3;
  for (let cells = 220; ; cells = Math.floor(cells * 0.8)) {
    const first = new Map(), group = new Uint32Array(n);
    const scale = extent.map((value) => value / longest * cells / 65535);
    for (let k = 0; k < n; k++) {
      const key = (Math.floor(place[3 * k] * scale[0]) * 1024 + Math.floor(place[3 * k + 1] * scale[1])) * 1024 + Math.floor(place[3 * k + 2] * scale[2]);
      const found = first.get(key);
      if (found === undefined) { first.set(key, k); group[k] = k; } else group[k] = found;
    }
    const out = new Uint32Array(faces.length);
    let count = 0;
    for (let k = 0; k < faces.length; k += 3) {
      const a = group[faces[k]], b = group[faces[k + 1]], c = group[faces[k + 2]];
      if (a === b || b === c || a === c) continue;
      out[count] = a; out[count + 1] = b; out[count + 2] = c;
      count += 3;
    }
    if (count <= 3 * most || cells < 40) return out.slice(0, count);
  }
}

// The same colours as the shader's.
function viridis(t) {
  t = Math.max(0, Math.min(1, t));
  const C = [[.2777, .0054, .3341], [.1051, 1.4046, 1.3846], [-.3309, .2148, .0951], [-4.6342, -5.7991, -19.3324],
    [6.2283, 14.1799, 56.6906], [4.7764, -13.7451, -65.3530], [-5.4355, 4.6459, 26.3124]];
  return [0, 1, 2].map((k) => Math.max(0, Math.min(1, C.reduceRight((sum, row) => sum * t + row[k], 0))));
}

// The colour of a byte of a field.
const shown = (field) => (value) => viridis((value / 255 - field.ends[0]) / (field.ends[1] - field.ends[0]));

// What a screenshot says beside the picture: the colour bar, and what was measured.
function captions(pen, box, canvas) {
  const ratio = canvas.width / canvas.clientWidth, bar = box.querySelector(".bar"), label = box.querySelector(".measured");
  pen.scale(ratio, ratio);
  pen.font = "13px system-ui, sans-serif";
  pen.textBaseline = "middle";
  if (bar && !bar.hidden) {
    const x = 16, y = canvas.clientHeight - 30, width = 240;
    for (let k = 0; k < width; k++) {
      pen.fillStyle = `rgb(${viridis(k / width).map((value) => Math.round(255 * value))})`;
      pen.fillRect(x + k, y, 1.5, 10);
    }
    const [low, middle, high] = [...bar.querySelectorAll("span")].map((tick) => tick.textContent);
    pen.fillStyle = "#e8eaed";
    pen.fillText(bar.querySelector("strong").textContent, x, y - 12);
    for (const [text, t, align] of [[low, 0, "left"], [middle, 0.5, "center"], [high, 1, "right"]]) {
      pen.textAlign = align;
      pen.fillText(text, x + t * width, y + 20);
    }
  }
  if (label && !label.hidden && label.classList.contains("placed")) {
    const there = label.getBoundingClientRect(), origin = canvas.getBoundingClientRect();
    pen.textAlign = "center";
    const x = there.left + there.width / 2 - origin.left, y = there.top + there.height / 2 - origin.top;
    pen.fillStyle = "rgba(22, 25, 30, .85)";
    pen.fillRect(x - there.width / 2, y - there.height / 2, there.width, there.height);
    pen.fillStyle = "#ffe15a";
    label.textContent.split("\n").forEach((line, k, lines) => pen.fillText(line, x, y + 18 * (k - (lines.length - 1) / 2)));
  }
}
