// A box that the model is cut by: two sliders for each axis.
function makeSection(box, scene, changed) {
  const panel = box.querySelector(".section");
  const low = scene.low, high = scene.low.map((value, k) => value + scene.extent[k]);
  const section = { from: low.map((v) => v - 1e3), to: high.map((v) => v + 1e3), on: false };
  if (!panel) return section;
  const sliders = [...panel.querySelectorAll("input")];
  function update() {
    for (let axis = 0; axis < 3; axis++) {
      const [a, b] = sliders.filter((input) => Number(input.dataset.axis) === axis).map(Number_);
      const ends = [Math.min(a, b), Math.max(a, b)].map((t) => low[axis] + t * (high[axis] - low[axis]));
      // An end that is not moved cuts nothing.
      section.from[axis] = Math.min(a, b) > 0 ? ends[0] : low[axis] - 1e3;
      section.to[axis] = Math.max(a, b) < 1 ? ends[1] : high[axis] + 1e3;
    }
    section.on = sliders.some((input) => Number_(input) > 0 && Number_(input) < 1);
    changed();
  }
  // Heights grow upwards, y downwards.
  const Number_ = (input) => (input.dataset.axis === "1" ? 1 - Number(input.value) / 1000 : Number(input.value) / 1000);
  panel.addEventListener("input", update);
  panel.addEventListener("click", (e) => {
    if (!e.target.closest("[data-clear]")) return;
    for (const input of sliders) input.value = input.dataset.start;
    update();
  });
  return section;
}
