// Taps two points of the model: their distance, and how well it is known.
function makeMeasure(box, view, painter, sigmaOf, changed) {
  const button = box.querySelector("[data-tool=measure]"), label = box.querySelector(".measured");
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
    say(on ? "Tap the first point" : "");
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
    say(ends.length === 1 ? "Tap the second point" : distance());
    place();
    changed();
  }
  function distance() {
    const [a, b] = ends, length = Math.hypot(...minus(a.point, b.point));
    const known = a.sigma !== null && b.sigma !== null;
    if (!known) return metres(length);
    const sigma = Math.hypot(a.sigma, b.sigma);
    return sigma > Math.max(length, 1) ? `${metres(length)}, not constrained` : `${metres(length)} ± ${metres(sigma)}`;
  }
  // The words stand beside the line, or at the top until there is one.
  function place() {
    const shown = ends.length === 2 && view.onScreen(along(ends[0].point, minus(ends[1].point, ends[0].point), 0.5));
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
