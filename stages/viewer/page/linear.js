// Small linear algebra: vectors are arrays, matrices row-major arrays of 16 that act on columns.

export const add = (a, b, scale = 1) => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
export const sub = (a, b) => add(a, b, -1);
export const times = (a, k) => [a[0] * k, a[1] * k, a[2] * k];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => times(a, 1 / (length(a) || 1));
export const turned = (v, axis, angle) => // Rodrigues
  add(add(times(v, Math.cos(angle)), cross(axis, v), Math.sin(angle)), axis, dot(axis, v) * (1 - Math.cos(angle)));

export const multiply = (a, b) => {
  const out = new Array(16).fill(0);
  for (let r = 0; r < 4; r++)
    for (let c = 0; c < 4; c++) for (let k = 0; k < 4; k++) out[4 * r + c] += a[4 * r + k] * b[4 * k + c];
  return out;
};
export const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
export const moved = (m, p, w = 1) => [0, 4, 8].map((r) => m[r] * p[0] + m[r + 1] * p[1] + m[r + 2] * p[2] + w * m[r + 3]);

// A rotation of degrees about x, then y, then z (fixed axes, as in scene files) around a centre, then a shift.
export const placed = (degrees, shift, centre) => {
  const columns = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((axis) => {
    let v = axis;
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((about, i) => { v = turned(v, about, (degrees[i] * Math.PI) / 180); });
    return v;
  });
  const m = [...IDENTITY];
  for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) m[4 * r + c] = columns[c][r];
  const back = moved(m, centre, 0);
  for (let r = 0; r < 3; r++) m[4 * r + 3] = centre[r] - back[r] + shift[r];
  return m;
};

// A pose: right, up, back (unit vectors) and eye. Cameras look along -back.
export const poseOf = (matrix) => {
  const column = (c) => [matrix[0][c], matrix[1][c], matrix[2][c]];
  return { right: column(0), up: column(1), back: column(2), eye: column(3) };
};
export const matrixOf = ({ right, up, back, eye }) =>
  [0, 1, 2].map((r) => [right[r], up[r], back[r], eye[r]]).concat([[0, 0, 0, 1]]);
export const viewOf = ({ right, up, back, eye }) => [
  ...right, -dot(right, eye), ...up, -dot(up, eye), ...back, -dot(back, eye), 0, 0, 0, 1,
];
// x, y: half the picture's width and height at distance 1. cx, cy: the axis in the picture, in [-1, 1].
export const perspective = (x, y, near, far, cx = 0, cy = 0) => [
  1 / x, 0, -cx, 0, 0, 1 / y, -cy, 0, 0, 0, (far + near) / (near - far), (2 * far * near) / (near - far), 0, 0, -1, 0,
];
export const orthographic = (x, y, near, far) => [
  1 / x, 0, 0, 0, 0, 1 / y, 0, 0, 0, 0, 2 / (near - far), (far + near) / (near - far), 0, 0, 0, 1,
];
export const looking = (eye, target, up) => {
  const back = unit(sub(eye, target));
  let right = cross(up, back);
  if (length(right) < 1e-6) right = cross([0, 1, 0.001], back);
  right = unit(right);
  return { right, up: cross(back, right), back, eye };
};
export const solved = (m) => { // inverse of a 4x4, by Gauss and Jordan
  const a = [0, 1, 2, 3].map((r) => [...m.slice(4 * r, 4 * r + 4), ...[0, 1, 2, 3].map((c) => +(c === r))]);
  for (let c = 0; c < 4; c++) {
    const best = [0, 1, 2, 3].slice(c).reduce((x, y) => (Math.abs(a[y][c]) > Math.abs(a[x][c]) ? y : x));
    [a[c], a[best]] = [a[best], a[c]];
    a[c] = a[c].map((v) => v / a[c][c]);
    for (let r = 0; r < 4; r++) if (r !== c) { const f = a[r][c]; a[r] = a[r].map((v, k) => v - f * a[c][k]); }
  }
  return a.flatMap((row) => row.slice(4));
};
