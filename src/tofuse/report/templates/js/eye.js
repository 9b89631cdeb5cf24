// Where the model is seen from. The world is x right, y down, z forward.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => a.map((value, k) => value - b[k]);
const along = (from, direction, length) => from.map((value, k) => value + direction[k] * length);

function makeEye(canvas, scene, changed) {
  const eye = { yaw: scene.yaw, pitch: scene.pitch, distance: 1.2 * scene.size, target: scene.center.slice() };
  const HALF = Math.tan(0.35);
  let flight = 0, through = false;

  // Rows turn the world into the view: right, down, forward.
  function turn() {
    const cy = Math.cos(eye.yaw), sy = Math.sin(eye.yaw), cp = Math.cos(eye.pitch), sp = Math.sin(eye.pitch);
    return [[cy, 0, sy], [sp * sy, cp, -sp * cy], [-cp * sy, sp, cp * cy]];
  }
  // Half the height that is seen at depth 1; less of a canvas that is narrow.
  function lens() {
    const aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    const f = Math.min(1, aspect / 1.2) / HALF;
    return [f / aspect, f];
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
    through = false;
  }
  function look(changes, points, nearest = 0.3 * scene.size) {
    stop();
    Object.assign(eye, changes);
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
    const to = { ...eye };
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    glide(from, to);
  }
  function glide(from, to) {
    const began = performance.now();
    const turned = Math.atan2(Math.sin(to.yaw - from.yaw), Math.cos(to.yaw - from.yaw));
    const step = (now) => {
      const t = Math.min(1, Math.max(0, (now - began) / 450)), s = t * t * (3 - 2 * t);
      eye.yaw = from.yaw + turned * s;
      eye.pitch = from.pitch + (to.pitch - from.pitch) * s;
      eye.distance = from.distance * (to.distance / from.distance) ** s;
      eye.target = from.target.map((value, k) => value + (to.target[k] - value) * s);
      changed();
      if (t < 1) flight = requestAnimationFrame(step);
    };
    Object.assign(eye, from);
    flight = requestAnimationFrame(step);
  }
  // Stands where a camera stood and looks where it looked; T is (3, 4) row by row.
  function lookThrough(T) {
    stop();
    through = true;
    const forward = [T[2], T[6], T[10]], distance = 0.25 * scene.size;
    const to = {
      yaw: Math.atan2(-forward[0], forward[2]),
      pitch: Math.asin(Math.max(-1, Math.min(1, forward[1]))),
      distance,
      target: along([T[3], T[7], T[11]], forward, distance),
    };
    glide({ ...eye }, to);
  }
  function orbit(dx, dy) {
    stop();
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
    eye, turn, lens, place, matrices, onScreen, behind, look, flyTo, lookThrough, orbit, pan, zoom,
    get through() { return through; },
  };
}
