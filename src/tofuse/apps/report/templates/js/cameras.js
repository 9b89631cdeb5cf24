// Cameras as pyramids, coloured by what became of their frames or by how well they are known.
const STATES = [[0.35, 0.69, 0.96], [0.95, 0.68, 0.22], [0.95, 0.3, 0.35], [0.6, 0.62, 0.66]];
const DIM = [0.3, 0.36, 0.43], MARKED = [1, 0.36, 0.42], BEFORE = [0.94, 0.63, 0.24], CHOSEN = [1, 0.88, 0.35];
const MOST = 240;  // pyramids that are drawn of a long recording

function makeCameras(painter, size, frames) {
  const { index, status, after, before, errors, rig } = frames, n = index.length;
  const cameraOf = (row) => (rig ? rig.of[row] : 0);
  const own = (row) => (rig && status[row] === "0" ? rig.colors[cameraOf(row)].map((value) => value / 255) : STATES[Number(status[row])]);
  const pose = (of, row) => {
    const T = of.subarray(12 * row, 12 * row + 12);
    return T.some((value) => value !== 0) ? T : null;
  };
  const at = (T, x, y, z) => [0, 4, 8].map((k) => T[k] * x + T[k + 1] * y + T[k + 2] * z + T[k + 3]);
  function pyramid(T, edge) {
    const ends = [[-.5, -.4], [.5, -.4], [.5, .4], [-.5, .4]].map(([x, y]) => at(T, x * edge, y * edge, .8 * edge));
    const tip = at(T, 0, 0, 0);
    return ends.flatMap((end, k) => [...tip, ...end, ...end, ...ends[(k + 1) % 4]]);
  }
  const bytesOf = (color) => color.map((value) => Math.round(255 * value));

  function drawn(of, inkOf, isMarked) {
    const places = [], colors = [], step = Math.ceil(n / MOST);
    const paths = [];  // of each camera of a rig, where it was last and where its last pyramid is
    let first = true, markedDrawn = 0;
    // A camera that hardly moved since its last pyramid would only make a blot.
    const moved = (T, shown) => !shown || Math.hypot(...minus(at(T, 0, 0, 0), at(shown, 0, 0, 0))) > 0.007 * size
      || T[2] * shown[2] + T[6] * shown[6] + T[10] * shown[10] < 0.93;
    const put = (lines, color) => {
      for (const value of lines) places.push(value);
      for (let k = 0; k < lines.length / 3; k++) colors.push(...color);
    };
    for (let row = 0; row < n; row++) {
      const T = pose(of, row), marked = isMarked(row);
      if (!T) continue;
      const color = bytesOf(inkOf(row)), here = at(T, 0, 0, 0), path = (paths[cameraOf(row)] ||= {});
      if (path.last) put([...path.last, ...here], color);
      path.last = here;
      if (((rig || row % step === 0) && moved(T, path.shown)) || (marked && markedDrawn++ < MOST) || status[row] !== "0") {
        put(pyramid(T, (marked ? 0.026 : 0.018) * size), color);
        path.shown = T;
      }
      // The first camera is larger, as in the thesis.
      if (first) put(pyramid(T, 0.032 * size), color);
      first = false;
    }
    return {
      place: painter.buffer(new Float32Array(places)), color: painter.buffer(new Uint8Array(colors)),
      count: places.length / 3,
    };
  }
  // Lets go of the buffers of what was drawn before.
  function free(set) {
    if (!set) return;
    painter.gl.deleteBuffer(set.place);
    painter.gl.deleteBuffer(set.color);
  }
  let now = null;
  const earlier = drawn(before, () => BEFORE, () => false);
  const chosen = { place: painter.buffer(new Float32Array(48)), color: CHOSEN, count: 0, over: 0.002 };

  function paint(ramp, isMarked) {
    free(now);
    const any = Boolean(isMarked);
    now = drawn(after, (row) => {
      if (any) return isMarked(row) ? MARKED : DIM;
      return ramp && errors ? ramp(errors[row]) : own(row);
    }, any ? isMarked : () => false);
  }
  function choose(row) {
    const T = row < 0 ? null : pose(after, row);
    chosen.count = 0;
    if (T) {
      painter.gl.bindBuffer(painter.gl.ARRAY_BUFFER, chosen.place);
      painter.gl.bufferData(painter.gl.ARRAY_BUFFER, new Float32Array(pyramid(T, 0.04 * size)), painter.gl.DYNAMIC_DRAW);
      chosen.count = 16;
    }
  }
  // The frame whose camera lies nearest to a place on the canvas, and not further than a fingertip.
  function near(view, x, y) {
    let best = -1, least = 14;
    for (let row = 0; row < n; row++) {
      const T = pose(after, row), seen = T && view.onScreen(at(T, 0, 0, 0));
      const off = seen ? Math.hypot(seen[0] - x, seen[1] - y) : Infinity;
      if (off < least) { best = row; least = off; }
    }
    return best;
  }
  // Camera centres of frames, or of the posed ones next to them where they have no pose.
  function centres(isMarked) {
    const out = [];
    let before_ = null, waiting = false;
    for (let row = 0; row < n; row++) {
      const T = pose(after, row), here = T && at(T, 0, 0, 0), marked = isMarked(row);
      if (marked && here) out.push(here, at(T, 0, 0, 0.08 * size));
      if (marked && !here && before_) { out.push(before_); waiting = true; }
      if (here && waiting) { out.push(here); waiting = false; }
      if (here) before_ = here;
    }
    return out;
  }
  return { paint, choose, near, centres, chosen, earlier, get now() { return now; }, pose: (row) => pose(after, row) };
}
