// The frames' pictures, the strip of frames, and everything on the page that points at frames.
function startFrames(bus) {
  const strip = document.getElementById("strip"), caption = document.getElementById("strip-caption");
  const player = document.getElementById("player"), data = document.querySelector("script#pictures");
  const pictures = data ? JSON.parse(data.textContent) : null;
  const choose = (index, shown) => bus.dispatchEvent(new CustomEvent("chosen", { detail: { index, shown } }));
  const nearest = (index) => {
    let best = 0;
    pictures.index.forEach((other, k) => { if (Math.abs(other - index) < Math.abs(pictures.index[best] - index)) best = k; });
    return best;
  };

  if (player && pictures) {
    const slider = document.getElementById("frame"), words = document.getElementById("frame-description");
    const last = pictures.index.length - 1, here = () => Number(slider.value);
    const show = (row) => {
      slider.value = String(row);
      words.textContent = pictures.descriptions[row];
      words.className = pictures.status[row];
      for (const image of player.querySelectorAll("img")) {
        const source = pictures.images[image.dataset.kind][row];
        image.hidden = !source;  // not every frame has a colour image
        if (source) image.src = source;
      }
    };
    const go = (row) => choose(pictures.index[Math.max(0, Math.min(last, row))], false);
    bus.addEventListener("chosen", (e) => show(nearest(e.detail.index)));
    slider.addEventListener("input", () => go(here()));
    player.addEventListener("click", (e) => {
      const button = e.target.closest("button");
      if (!button) return;
      if (button.dataset.step) go(here() + Number(button.dataset.step));
      if (button.dataset.bad) {
        for (let k = 1; k <= last + 1; k++) {
          const row = (here() + k) % (last + 1);
          if (pictures.status[row] !== "tracked") { go(row); return; }
        }
      }
    });
    player.querySelector("[data-bad]").hidden = pictures.status.every((status) => status === "tracked");
    player.classList.add("live");
    show(0);
  }

  // The tooltip of a frame can also be tapped.
  if (strip) {
    const tell = (e) => {
      const cell = e.target.closest("rect"), title = cell && cell.querySelector("title");
      if (title) caption.textContent = title.textContent;
      return cell;
    };
    strip.addEventListener("pointerover", tell);
    strip.addEventListener("click", (e) => { const cell = tell(e); if (cell) choose(Number(cell.dataset.frame), false); });
    bus.addEventListener("marked", (e) => {
      const { ranges } = e.detail;
      strip.classList.toggle("marks", ranges.length > 0);
      for (const cell of strip.querySelectorAll("rect")) {
        const k = Number(cell.dataset.frame);
        cell.classList.toggle("marked", ranges.some(([a, b]) => a <= k && k <= b));
      }
    });
  }

  // A link to frames shows them in the 3D view, in the strips and in the pictures; again: all frames.
  const links = [...document.querySelectorAll("a[data-ranges]")], viewer = document.getElementById("viewer");
  for (const link of links) {
    link.addEventListener("click", (e) => {
      if (!viewer || !viewer.classList.contains("live")) return;
      e.preventDefault();
      const fresh = !link.classList.contains("on"), ranges = fresh ? JSON.parse(link.dataset.ranges) : [];
      for (const other of links) other.classList.toggle("on", other === link && fresh);
      bus.dispatchEvent(new CustomEvent("marked", { detail: { ranges } }));
      if (fresh) choose(ranges[0][0], true);
      const there = viewer.getBoundingClientRect();
      if (there.top < 0 || there.top > innerHeight / 3) viewer.scrollIntoView({ block: "start" });
    });
  }

  // The frame that is chosen, small in a corner of the 3D view.
  const inset = document.querySelector("#viewer .inset");
  if (inset) {
    // `tofuse view` serves the images of all frames as they were recorded.
    const served = document.documentElement.dataset.frames, image = inset.querySelector("img");
    const caption = inset.querySelector("figcaption");
    let index = 0, waiting = 0;
    function show(source, own) {
      image.src = source;
      image.hidden = false;
      image.dataset.own = own ? "1" : "";
      bus.dispatchEvent(new Event("pictured"));
    }
    function fetchLater(wanted) {
      clearTimeout(waiting);
      waiting = setTimeout(() => {
        const full = new Image();
        full.onload = () => {
          if (wanted !== index) return;
          caption.textContent = caption.textContent.replace(/ \(image: .*\)/, "");
          show(full.src, true);
        };
        full.src = `${served}${wanted}.png`;
      }, 120);
    }
    bus.addEventListener("chosen", (e) => {
      index = e.detail.index;
      if (e.detail.shown) inset.hidden = false;
      const row = pictures ? nearest(index) : -1, same = row >= 0 && pictures.index[row] === index;
      image.hidden = true;
      if (row >= 0) show(pictures.images.color?.[row] || pictures.images.range[row], same);
      if (served) fetchLater(index);
      caption.textContent = same
        ? pictures.descriptions[row]
        : `Frame ${index}${row >= 0 ? ` (image: frame ${pictures.index[row]})` : ""}`;
    });
    inset.addEventListener("click", (e) => {
      if (e.target.closest("[data-close]")) inset.hidden = true;
      if (e.target.closest("[data-through]")) bus.dispatchEvent(new CustomEvent("through", { detail: { index } }));
    });
  }
}
