// The image of a frame over the model, for as long as one looks through its camera.
function makeOverlay(box, view, changed) {
  const overlay = box.querySelector(".overlay"), inset = box.querySelector(".inset");
  if (!overlay || !inset) return { place() {} };
  const image = overlay.querySelector("img"), small = inset.querySelector("img");
  const fade = inset.querySelector("label"), slider = fade.querySelector("input"), button = inset.querySelector("[data-through]");
  slider.addEventListener("input", changed);

  function place() {
    const there = view.window(), shown = Boolean(there && small.dataset.own && !small.hidden);
    box.classList.toggle("through", view.through);
    button.textContent = view.through ? "Back to the model" : "Look through this camera";
    overlay.hidden = fade.hidden = !shown;
    if (!shown) return;
    if (image.src !== small.src) image.src = small.src;
    image.style.opacity = String(slider.value / 100);
    for (const side in there) image.style[side] = `${there[side]}px`;
  }
  return { place };
}
