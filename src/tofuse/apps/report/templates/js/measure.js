// Taps points of the model: where one is, how far two are apart, and how well that is known.
function makeMeasure(box, view, painter, { sigmaOf, axes, changed }) {
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
  // Coordinates in the world of the trajectory and of the files; the model is shown in turned axes.
  function position() {
    const [{ point, sigma }] = ends;
    const world = axes ? [0, 1, 2].map((k) => dot(axes.map((row) => row[k]), point)) : point;
    return bounded(`${world.map((value) => value.toFixed(3).replace("-", "−")).join(", ")} m`, sigma, 1);
  }
  function distance() {
    const [a, b] = ends, length = Math.hypot(...minus(a.point, b.point));
    const known = a.sigma !== null && b.sigma !== null;
    return bounded(metres(length), known ? Math.hypot(a.sigma, b.sigma) : null, Math.max(length, 1));
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
    const shown = middle && view.onScreen(middle);
    label.classList.toggle("placed", Boolean(shown));
    if (!shown) { label.style.transform = ""; return; }
    label.style.transform = `translate(${Math.round(shown[0])}px, ${Math.round(shown[1])}px) translate(-50%, -150%)`;
  }
  button.addEventListener("click", () => toggle());
  return { toggle, add, miss: () => say("No surface there: tap the model"), place, line, get on() { return on; } };
}

function metres(value) {
  const mm = 1000 * value;
  return mm < 10 ? `${mm.toFixed(1)} mm` : mm < 1000 ? `${mm.toFixed(0)} mm` : `${value.toFixed(3)} m`;
}
