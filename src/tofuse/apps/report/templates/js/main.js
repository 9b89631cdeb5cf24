(function () {
  const box = document.getElementById("viewer"), data = document.getElementById("scene");
  // "chosen": a frame; "marked": ranges of frames; "through": look through a frame's camera.
  const bus = new EventTarget();
  startFrames(bus);
  if (box && data) startViewer(box, JSON.parse(data.textContent), bus);
})();
