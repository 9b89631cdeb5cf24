// Where the model is seen from. The world is x right, y down, z forward.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => a.map((value, k) => value - b[k]);
const along = (from, direction, length) => from.map((value, k) => value + direction[k] * length);

function makeEye(canvas, scene, changed) {
  // `blend` is 0 for the lens of the view and 1 for that of a camera one looks through.
  const eye = { yaw: scene.yaw, pitch: scene.pitch, roll: 0, blend: 0, distance: 1.2 * scene.size, target: scene.center.slice() };
  const HALF = Math.tan(0.35);
  let flight = 0, through = false, gliding = false;

  // Rows turn the world into the view: right, down, forward.
  function turn({ yaw, pitch, roll } = eye) {
    const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
    const right = [cy, 0, sy], down = [sp * sy, cp, -sp * cy], c = Math.cos(roll), s = Math.sin(roll);
    return [
      right.map((value, k) => c * value + s * down[k]), down.map((value, k) => c * value - s * right[k]),
      [-cp * sy, sp, cp * cy],
    ];
  }
  // Half the height that is seen at depth 1; less of a canvas that is narrow.
  function lens() {
    const aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    const f = Math.min(1, aspect / 1.2) / HALF, own = [f / aspect, f];
    if (!scene.lens || !eye.blend) return own;
    const { fx, fy } = scene.lens, size = 2 * imageScale();
    const camera = [size * fx / canvas.clientWidth, size * fy / canvas.clientHeight];
    return own.map((value, k) => value * (camera[k] / value) ** eye.blend);
  }
  // CSS pixels per pixel of a camera's image that fits in the canvas, its optical axis in the middle.
  function imageScale() {
    const { width, height, cx, cy } = scene.lens;
    const half = (centre, size) => Math.max(centre + 0.5, size - 0.5 - centre);
    return Math.min(canvas.clientWidth / half(cx, width), canvas.clientHeight / half(cy, height)) / 2;
  }
  // Where the image of the camera that one looks through lies on the canvas, in CSS pixels, or null.
  function window_() {
    if (!through || gliding || !scene.lens) return null;
    const { width, height, cx, cy } = scene.lens, scale = imageScale();
    return {
      left: canvas.clientWidth / 2 - scale * (cx + 0.5), top: canvas.clientHeight / 2 - scale * (cy + 0.5),
      width: scale * width, height: scale * height,
    };
  }
  const place = () => along(eye.target, turn()[2], -eye.distance);

  // Matrices for OpenGL, which looks along -z with y up: the second and third rows change sign.
  function matrices() {
    const R = turn(), t = R.map((row) => -dot(row, eye.target));
    t[2] += eye.distance;
    const view = [];
    for (let k = 0; k < 3; k++) view.push(R[0][k], -R[1][k], -R[2][k], 0);
    view.push(t[0], -t[1], -t[2], 1);
    const [fx, fy] = lens(), near = 0.01 * eye.distance, far = eye.distance + 20 * scene.size;
    const projection = [fx, 0, 0, 0, 0, fy, 0, 0,
      0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
    return { view: new Float32Array(view), projection: new Float32Array(projection), near, far };
  }
  // From a point to the canvas, in CSS pixels; null behind the eye.
  function onScreen(point) {
    const from = minus(point, place()), R = turn(), [fx, fy] = lens(), z = dot(R[2], from);
    if (z <= 0) return null;
    return [(1 + fx * dot(R[0], from) / z) / 2 * canvas.clientWidth, (1 + fy * dot(R[1], from) / z) / 2 * canvas.clientHeight];
  }
  // The point at a depth behind a pixel.
  function behind(x, y, z) {
    const R = turn(), [fx, fy] = lens();
    const right = (2 * x / canvas.clientWidth - 1) / fx * z, down = (2 * y / canvas.clientHeight - 1) / fy * z;
    return place().map((value, k) => value + right * R[0][k] + down * R[1][k] + z * R[2][k]);
  }
  // Moves the eye until points fill the canvas, all but a border.
  function fit(points, nearest) {
    const R = turn(), f = lens();
    for (let round = 0; round < 8; round++) {
      let fill = 0;
      for (let k = 0; k < 2; k++) {
        const seen = points.map((point) => {
          const from = minus(point, eye.target);
          return f[k] * dot(R[k], from) / Math.max(dot(R[2], from) + eye.distance, 0.05 * scene.size);
        });
        const low = Math.min(...seen), high = Math.max(...seen);
        fill = Math.max(fill, (high - low) / 2);
        eye.target = along(eye.target, R[k], (low + high) / 2 * eye.distance / f[k]);
      }
      eye.distance = Math.max(nearest, eye.distance * (1 + fill / 0.9) / 2);
    }
  }
  function stop() {
    cancelAnimationFrame(flight);
    through = gliding = false;
  }
  function look(changes, points, nearest = 0.3 * scene.size) {
    stop();
    Object.assign(eye, { roll: 0, blend: 0 }, changes);
    const sum = points.reduce((total, point) => along(total, point, 1), [0, 0, 0]);
    eye.target = sum.map((value) => value / points.length);
    eye.distance = Math.max(nearest, scene.size);
    fit(points, nearest);
    changed();
  }
  // The same, but so that one sees the way.
  function flyTo(changes, points, nearest) {
    const from = { ...eye };
    look(changes, points, nearest);
    glide(from, { ...eye });
  }
  function glide(from, to) {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) { jump(to); return; }
    gliding = true;
    const began = performance.now();
    const turned = Math.atan2(Math.sin(to.yaw - from.yaw), Math.cos(to.yaw - from.yaw));
    const step = (now) => {
      const t = Math.min(1, Math.max(0, (now - began) / 450)), s = t * t * (3 - 2 * t);
      eye.yaw = from.yaw + turned * s;
      for (const name of ["pitch", "roll", "blend"]) eye[name] = from[name] + (to[name] - from[name]) * s;
      eye.distance = from.distance * (to.distance / from.distance) ** s;
      eye.target = from.target.map((value, k) => value + (to.target[k] - value) * s);
      gliding = t < 1;
      changed();
      if (gliding) flight = requestAnimationFrame(step);
    };
    Object.assign(eye, from);
    flight = requestAnimationFrame(step);
  }
  function jump(to) {
    Object.assign(eye, to);
    changed();
  }
  // Stands where a camera stood and looks where it looked; T is (3, 4) row by row.
  function lookThrough(T) {
    const move = through ? jump : (to) => glide({ ...eye }, to);
    stop();
    through = true;
    const [right, , forward] = [0, 1, 2].map((k) => [T[k], T[4 + k], T[8 + k]]), distance = 0.25 * scene.size;
    const to = {
      yaw: Math.atan2(-forward[0], forward[2]),
      pitch: Math.asin(Math.max(-1, Math.min(1, forward[1]))),
      roll: 0, blend: 1, distance,
      target: along([T[3], T[7], T[11]], forward, distance),
    };
    const [level, down] = turn(to);
    to.roll = Math.atan2(dot(right, down), dot(right, level));
    move(to);
  }
  function orbit(dx, dy) {
    stop();
    eye.roll *= 0.85;  // it becomes upright again while it is turned
    eye.yaw -= dx * 0.006;
    eye.pitch = Math.max(-1.57, Math.min(1.57, eye.pitch + dy * 0.006));
    changed();
  }
  function pan(dx, dy) {
    stop();
    const R = turn(), step = 2 * eye.distance / lens()[1] / canvas.clientHeight;
    eye.target = along(along(eye.target, R[0], -step * dx), R[1], -step * dy);
    changed();
  }
  // What lies below (x, y) stays there.
  function zoom(factor, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {
    stop();
    const distance = Math.max(0.005 * scene.size, Math.min(20 * scene.size, eye.distance * factor));
    const fixed = behind(x, y, eye.distance);
    eye.target = fixed.map((value, k) => value + (eye.target[k] - value) * distance / eye.distance);
    eye.distance = distance;
    changed();
  }
  return {
    eye, turn, lens, place, matrices, onScreen, behind, window: window_, look, flyTo, lookThrough, orbit, pan, zoom,
    get through() { return through; },
  };
}
