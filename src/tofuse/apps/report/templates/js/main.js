(function () {
  const box = document.getElementById("viewer"), data = document.getElementById("scene");
  // "chosen": a frame; "marked": ranges of frames; "through": look through a frame's camera.
  const bus = new EventTarget();
  // What a link leads to may be folded.
  const unfold = (id) => {
    const target = id && document.getElementById(id);
    for (let box = target && target.closest("details"); box; box = box.parentElement.closest("details")) box.open = true;
  };
  document.addEventListener("click", (e) => {
    const link = e.target.closest('a[href^="#"]');
    if (link) unfold(link.hash.slice(1));
  });
  unfold(location.hash.slice(1));
  startFrames(bus);
  if (box && data) startViewer(box, JSON.parse(data.textContent), bus);
})();
