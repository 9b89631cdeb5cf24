// Mouse, fingers and keys. One finger that moves up or down scrolls the page, unless full screen.
function listen(canvas, view, { reset, tap }) {
  const fingers = new Map();
  let travelled = 0;
  const middle = () => {
    const [a, b] = [...fingers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, span: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  const here = (e) => {
    const box = canvas.getBoundingClientRect();
    return [e.clientX - box.left, e.clientY - box.top];
  };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    canvas.focus({ preventScroll: true });
    if (!fingers.size) travelled = 0;
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    if (e.pointerType === "mouse") e.preventDefault();
  });
  // Two fingers are for the model, not for the page.
  canvas.addEventListener("touchstart", (e) => { if (e.touches.length > 1) e.preventDefault(); }, { passive: false });
  canvas.addEventListener("pointermove", (e) => {
    const last = fingers.get(e.pointerId);
    if (!last) return;
    const now = { x: e.clientX, y: e.clientY };
    travelled += Math.hypot(now.x - last.x, now.y - last.y);
    if (fingers.size === 1) {
      const move = e.shiftKey || e.buttons & 6 ? view.pan : view.orbit;
      if (travelled > 3) move(now.x - last.x, now.y - last.y);
      fingers.set(e.pointerId, now);
    } else if (fingers.size === 2) {
      const old = middle();
      fingers.set(e.pointerId, now);
      const fresh = middle();
      view.pan(fresh.x - old.x, fresh.y - old.y);
      const [x, y] = here({ clientX: fresh.x, clientY: fresh.y });
      if (fresh.span > 0) view.zoom(old.span / fresh.span, x, y);
    }
  });
  canvas.addEventListener("pointerup", (e) => {
    if (fingers.delete(e.pointerId) && !fingers.size && travelled <= 6 && e.button === 0) tap(...here(e));
  });
  canvas.addEventListener("pointercancel", (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("dblclick", reset);
  canvas.addEventListener("wheel", (e) => {
    if (document.activeElement !== canvas && !e.ctrlKey) return;  // the page scrolls on
    e.preventDefault();
    const far = Math.max(-60, Math.min(60, e.deltaMode ? 20 * e.deltaY : e.deltaY));
    view.zoom(Math.exp(far * 0.002), ...here(e));
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const move = e.shiftKey ? view.pan : view.orbit, step = 20;
    const keys = {
      ArrowLeft: () => move(-step, 0), ArrowRight: () => move(step, 0),
      ArrowUp: () => move(0, -step), ArrowDown: () => move(0, step),
      "+": () => view.zoom(0.85), "=": () => view.zoom(0.85), "-": () => view.zoom(1.18), 0: reset,
    };
    if (!keys[e.key] || e.ctrlKey || e.metaKey) return;
    keys[e.key]();
    e.preventDefault();
  });
}
