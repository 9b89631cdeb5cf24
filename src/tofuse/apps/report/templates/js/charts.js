// Line charts by uPlot, of the data that `report/plots.py` puts into the page, in the page's colours.
(function () {
  const style = getComputedStyle(document.body);
  const color = (name) => () => style.getPropertyValue(`--${name}`);
  const text = (value, digits = 6) => (value === null ? "" : String(Number(value.toPrecision(digits))).replace("-", "−"));
  const drawn = new Map();

  // From 0, with 0, or around the values; of a logarithmic axis as uPlot chooses.
  function range(c) {
    if (c.scale.distr) return undefined;
    return (chart, low, high) => {
      if (low === null) return [0, 1];
      if (c.floor) return [0, 1.05 * high || 1];
      return uPlot.rangeNum(c.zero ? Math.min(0, low) : low, c.zero ? Math.max(0, high) : high, 0.1, true);
    };
  }

  // The line y = 0, and crosses on the axis at the frames without a value.
  function marks(chart, c) {
    const { ctx, bbox } = chart, end = bbox.left + bbox.width, ratio = devicePixelRatio;
    const stroke = (name, width, trace) => {
      ctx.strokeStyle = color(name)();
      ctx.lineWidth = width * ratio;
      ctx.beginPath();
      trace();
      ctx.stroke();
    };
    ctx.save();
    if (c.zero) {
      const y = chart.valToPos(0, "y", true);
      stroke("muted", 0.8, () => { ctx.moveTo(bbox.left, y); ctx.lineTo(end, y); });
    }
    stroke("bad", 1.2, () => {
      const y = bbox.top + bbox.height, r = 2.5 * ratio;
      for (const x of c.bad.map((frame) => chart.valToPos(frame, "x", true))) {
        if (x < bbox.left || x > end) continue;
        for (const side of [-r, r]) { ctx.moveTo(x - side, y - r); ctx.lineTo(x + side, y + r); }
      }
    });
    ctx.restore();
  }

  function draw(box) {
    const c = JSON.parse(box.dataset.chart), names = Object.keys(c.series);
    const readout = box.parentNode.querySelector("span");
    const tell = ({ cursor: { idx } }) => {
      const at = (name) => text(c.series[name][idx], 4) || "–";
      readout.textContent = idx === null || idx === undefined
        ? ""
        : `${c.xlabel} ${c.x[idx]}: ${names.map((name) => (names.length > 1 ? `${name} ${at(name)}` : at(name))).join(", ")}`;
    };
    const axis = {
      font: `11px ${style.fontFamily}`, labelFont: `11px ${style.fontFamily}`, stroke: color("ink"),
      grid: { stroke: color("grid"), width: 0.8 }, ticks: { stroke: color("muted"), width: 0.8, size: 3 },
      values: (chart, splits) => splits.map((value) => text(value)),
    };
    const whole = [1, 2, 5].flatMap((k) => [k, 10 * k, 100 * k, 1e3 * k, 1e4 * k]).sort((a, b) => a - b);
    const lines = names.map((name) => (
      { stroke: color(name), width: 1.6, dash: name === "before" ? [6, 3] : undefined, points: { size: 4, fill: color(name) } }
    ));
    return new uPlot({
      width: box.clientWidth, height: box.clientHeight,
      padding: [8, 10, 0, 0],
      legend: { show: false },
      cursor: { y: false, sync: { key: c.xlabel } },
      scales: {
        x: { time: false, range: (chart, a, b) => { const pad = 0.01 * (b - a) || 0.5; return [a - pad, b + pad]; } },
        y: { ...c.scale, range: range(c) },
      },
      axes: [
        { ...axis, label: c.xlabel, labelSize: 16, size: 22, gap: 3, ...(c.x.every(Number.isInteger) ? { incrs: whole } : {}) },
        { ...axis, size: 48, gap: 3, space: 34 },
      ],
      series: [{}, ...lines],
      hooks: { draw: [(chart) => marks(chart, c)], setCursor: [tell] },
    }, [c.x, ...names.map((name) => c.series[name])], box);
  }

  function show(box) {
    seen.unobserve(box);
    if (drawn.has(box)) return;
    drawn.set(box, draw(box));
    resized.observe(box);
  }
  // A chart in closed details is not seen, and has no width.
  const seen = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) if (isIntersecting && target.clientWidth) show(target);
  }, { rootMargin: "300px" });
  const resized = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      if (target.clientWidth) drawn.get(target).setSize({ width: target.clientWidth, height: target.clientHeight });
    }
  });
  const boxes = [...document.querySelectorAll("[data-chart]")];
  for (const box of boxes) seen.observe(box);
  addEventListener("beforeprint", () => { for (const box of boxes) if (box.clientWidth) show(box); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const chart of drawn.values()) chart.redraw(false);
  });
})();
