// The frames below the 3D view: what became of each, how well it is known, and which are spoken of.
function makeTimeline(box, frames, ramp, bus) {
  const canvas = box.querySelector(".timeline canvas");
  if (!canvas || !frames || !frames.index.length) return;
  const caption = box.querySelector(".timeline span"), n = frames.index.length;
  const INKS = ["#2f9e62", "#f2ad38", "#f24c59", "#7b828c"], WORDS = ["tracked", "predicted", "lost", "skipped"];
  const LANES = ramp && frames.errors ? [[6, 10], [18, 10]] : [[6, 14]];
  let chosen = -1, ranges = [];
  function draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = Math.max(1, width * ratio);
    canvas.height = height * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const step = width / n, style = getComputedStyle(canvas);
    for (let x = 0; x < width; x += Math.max(1, step)) {
      // Where a pixel stands for several frames it shows the worst of them.
      const first = Math.floor(x / step + 1e-6), last = Math.min(n - 1, Math.max(first, Math.ceil((x + 1) / step) - 1));
      let worst = "0", error = 0;
      for (let row = first; row <= last; row++) {
        if ("0132".indexOf(frames.status[row]) > "0132".indexOf(worst)) worst = frames.status[row];
        if (frames.errors) error = Math.max(error, frames.errors[row]);
      }
      const wide = Math.max(1, step) + 0.4;
      pen.fillStyle = INKS[Number(worst)];
      pen.fillRect(x, LANES[0][0], wide, LANES[0][1]);
      if (LANES[1] && worst < "2") {
        pen.fillStyle = `rgb(${ramp(error).map((value) => Math.round(255 * value))})`;
        pen.fillRect(x, LANES[1][0], wide, LANES[1][1]);
      }
    }
    pen.fillStyle = style.getPropertyValue("--failed");
    for (const [a, b] of ranges) {
      const from = rowAt(a), to = rowAt(b);
      pen.fillRect(from * step, 0, Math.max(2, (to - from + 1) * step), 4);
    }
    if (chosen >= 0) {
      const x = (chosen + 0.5) * step;
      pen.fillStyle = style.getPropertyValue("--ink");
      pen.fillRect(x - 1, 2, 2, height - 4);
      pen.beginPath();
      pen.moveTo(x - 5, height);
      pen.lineTo(x + 5, height);
      pen.lineTo(x, height - 7);
      pen.fill();
    }
  }
  // The row of a frame, or of the one that follows.
  function rowAt(index) {
    let low = 0, high = n - 1;
    while (low < high) {
      const half = (low + high) >> 1;
      if (frames.index[half] < index) low = half + 1; else high = half;
    }
    return low;
  }
  const rowOf = (e) => {
    const there = canvas.getBoundingClientRect();
    return Math.max(0, Math.min(n - 1, Math.floor((e.clientX - there.left) / there.width * n)));
  };
  const describe = (row) => { caption.textContent = `Frame ${frames.index[row]}: ${WORDS[Number(frames.status[row])]}`; };
  canvas.addEventListener("pointermove", (e) => {
    describe(rowOf(e));
    if (e.buttons & 1) choose(rowOf(e));
  });
  canvas.addEventListener("pointerleave", () => { if (chosen >= 0) describe(chosen); });
  canvas.addEventListener("pointerdown", (e) => choose(rowOf(e)));
  function choose(row) {
    if (row === chosen) return;
    bus.dispatchEvent(new CustomEvent("chosen", { detail: { index: frames.index[row], shown: true } }));
  }
  bus.addEventListener("chosen", (e) => {
    const row = rowAt(e.detail.index);
    chosen = frames.index[row] === e.detail.index ? row : -1;
    if (chosen >= 0) describe(chosen);
    draw();
  });
  bus.addEventListener("marked", (e) => { ranges = e.detail.ranges; draw(); });
  new ResizeObserver(draw).observe(canvas);
  draw();
}
