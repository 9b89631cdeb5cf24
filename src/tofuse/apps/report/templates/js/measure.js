// Taps points of the model: where one is, how far two are apart, and how well that is known.
function makeMeasure(box, view, painter, { sigmaOf, axes, lengths, changed }) {
  const button = box.querySelector("[data-tool=measure]"), label = box.querySelector(".measured"), pins = box.querySelectorAll(".pin");
  const line = { place: painter.buffer(new Float32Array(6)), color: [1, 0.88, 0.35], count: 0, over: 0.002 };
  const ends = [];
  let on = false;
  const say = (text) => { label.hidden = !text; label.textContent = text; };

  function toggle(state = !on) {
    on = state;
    ends.length = 0;
    line.count = 0;
    button.setAttribute("aria-pressed", String(on));
    box.classList.toggle("measuring", on);
    say(on ? "Tap a point, or two for their distance" : "");
    place();
    changed();
  }
  function add(point, value) {
    if (ends.length === 2) ends.length = 0;
    ends.push({ point, sigma: sigmaOf(value) });
    const [a, b] = [ends[0].point, ends[ends.length - 1].point];
    const arm = 0.012 * view.eye.distance, cross = (p) => [0, 1, 2].flatMap((k) => {
      const d = [0, 0, 0];
      d[k] = arm / 2;
      return [...minus(p, d), ...along(p, d, 1)];
    });
    const all = [...a, ...b, ...cross(a), ...cross(b)];
    painter.gl.bindBuffer(painter.gl.ARRAY_BUFFER, line.place);
    painter.gl.bufferData(painter.gl.ARRAY_BUFFER, new Float32Array(all), painter.gl.DYNAMIC_DRAW);
    line.count = all.length / 3;
    say(ends.length === 1 ? position() : distance());
    place();
    changed();
  }
  // In the world of the trajectory and of the files; the model is shown in turned axes.
  const inWorld = (point) => (axes ? [0, 1, 2].map((k) => dot(axes.map((row) => row[k]), point)) : point);
  function position() {
    const [{ point, sigma }] = ends;
    return repeatable(`${inWorld(point).map((value) => value.toFixed(3).replace("-", "−")).join(", ")} m`, sigma, 1);
  }
  function distance() {
    const [a, b] = ends, length = Math.hypot(...minus(a.point, b.point));
    if (lengths && length) {
      const causes = lengths(inWorld(a.point), inWorld(b.point)), names = Object.keys(causes);
      const most = names.reduce((x, y) => (causes[y] > causes[x] ? y : x));
      const words = bounded(metres(length), Math.hypot(...Object.values(causes)), Math.max(length, 1));
      return words.includes("±") ? `${words}\nmostly ${CAUSES[most]}` : words;
    }
    const known = a.sigma !== null && b.sigma !== null;
    return repeatable(metres(length), known ? Math.hypot(a.sigma, b.sigma) : null, Math.max(length, 1));
  }
  // The bounds of single points don't include what all views have in common.
  function repeatable(words, bound, most) {
    const said = bounded(words, bound, most);
    return said.includes("±") ? `${said}\nwithout range errors` : said;
  }
  function bounded(words, bound, most) {
    if (bound === null) return words;
    return bound > most ? `${words}, not constrained` : `${words} ± ${metres(bound)}`;
  }
  // The words stand beside the points, or at the top until there is one.
  function place() {
    pins.forEach((pin, k) => {
      const there = ends[k] && view.onScreen(ends[k].point);
      pin.hidden = !there;
      if (there) pin.style.transform = `translate(${there[0]}px, ${there[1]}px)`;
    });
    const middle = ends.length && along(ends[0].point, minus(ends[ends.length - 1].point, ends[0].point), 0.5);
    const shown = middle && view.onScreen(middle), places = ends.map((end) => view.onScreen(end.point));
    label.classList.toggle("placed", Boolean(shown));
    if (!shown) { label.style.transform = ""; return; }
    const half = label.offsetWidth / 2 + 4, left = Math.max(half, Math.min(box.clientWidth - half, shown[0]));
    // Above both ends, unless they are apart.
    const covered = places.filter((there) => there && Math.abs(there[0] - left) < half + 8).map((there) => there[1]);
    const top = Math.min(shown[1], ...covered);
    label.style.transform = `translate(${Math.round(left)}px, ${Math.round(top)}px) translate(-50%, calc(-100% - 12px))`;
  }
  button.addEventListener("click", () => toggle());
  return { toggle, add, miss: () => say("No surface there: tap the model"), place, line, get on() { return on; } };
}

const CAUSES = { poses: "poses", focal: "focal length", offset: "range offset", scale: "depth scale", range: "local range errors", surface: "the surfaces" };

// The 95 % bounds of the distance of two points in the world by cause: `LengthErrors.between` in Python.
async function makeLengths({ centre, points, weights, cameras, sights, covariance, bounds }) {
  const [P, camera, sight, C] = await Promise.all([points, cameras, sights, covariance].map((text, k) => unpack(text, Float32Array, [3, 6, 3, 1][k])));
  const K = camera.length / 6, seen = await unpack(weights, Uint8Array, K);
  const nearest = (p) => {
    let best = 0, least = Infinity;
    for (let k = 0; k < P.length / 3; k++) {
      const square = (P[3 * k] - p[0]) ** 2 + (P[3 * k + 1] - p[1]) ** 2 + (P[3 * k + 2] - p[2]) ** 2;
      if (square < least) { least = square; best = k; }
    }
    return best;
  };
  return (a, b) => {
    const d = minus(a, b), length = Math.hypot(...d), e = d.map((value) => value / length);
    const h = new Float64Array(6 * K);
    let focal = 0, offset = 0, range = 0, surface = 0;
    for (const [end, sign] of [[a, 1], [b, -1]]) {
      const p = minus(end, centre), row = nearest(p), used = seen.subarray(K * row, K * row + K);
      const total = used.reduce((sum, value) => sum + value, 0);
      const motion = [...e, p[1] * e[2] - p[2] * e[1], p[2] * e[0] - p[0] * e[2], p[0] * e[1] - p[1] * e[0]];
      used.forEach((value, k) => {
        if (!value) return;
        const w = sign * value / total, arm = minus(p, camera.subarray(6 * k, 6 * k + 3)), axis = camera.subarray(6 * k + 3, 6 * k + 6);
        motion.forEach((m, i) => { h[6 * k + i] += w * m; });
        focal += length / 2 * Math.abs(w) * (1 - dot(axis, e) ** 2);
        offset += w * dot(arm, e) / Math.hypot(...arm);
        surface = Math.hypot(surface, w / Math.SQRT2);
      });
      range = Math.hypot(range, dot(sight.subarray(3 * row, 3 * row + 3), e));
    }
    // The lower triangle of the covariance, row by row.
    let poses = 0;
    for (let i = 0, at = 0; i < 6 * K; i++) {
      for (let j = 0; j <= i; j++, at++) poses += (i === j ? 1 : 2) * h[i] * C[at] * h[j];
    }
    const effects = { focal, offset, scale: length, range, surface };
    const others = Object.entries(effects).map(([name, effect]) => [name, (bounds[name] || 0) * Math.abs(effect)]);
    return { poses: Math.sqrt(Math.max(poses, 0)), ...Object.fromEntries(others) };
  };
}

function metres(value) {
  const mm = 1000 * value;
  return mm < 10 ? `${mm.toFixed(1)} mm` : mm < 1000 ? `${mm.toFixed(0)} mm` : `${value.toFixed(3)} m`;
}
