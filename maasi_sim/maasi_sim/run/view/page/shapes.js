// Lines, ellipses and boxes in the projection of a camera.

export function path(context, camera, points, closed = false) {
  context.beginPath();
  trace(context, camera, points);
  if (closed) context.closePath();
}

// Add a line through points to the path.
export function trace(context, camera, points) {
  points.forEach((point, index) => {
    const [x, y] = camera.project(point);
    if (index === 0) context.moveTo(x, y);
    else context.lineTo(x, y);
  });
}

// Return the corners of a rectangle at a height.
export function corners([[left, right], [low, high]], z) {
  return [[left, low, z], [right, low, z], [right, high, z], [left, high, z]];
}

// Draw an upright box as lines: a rectangle at each height, and what joins them.
export function edges(context, camera, sides, heights) {
  for (const z of heights) {
    path(context, camera, corners(sides, z), true);
    context.stroke();
  }
  for (const [x, y] of heights.length > 1 ? corners(sides) : []) {
    path(context, camera, heights.map((z) => [x, y, z]));
    context.stroke();
  }
}

// Return the context of a canvas, emptied and sized for sharp lines, in pixels of the page.
export function prepared(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  [canvas.width, canvas.height] = [width * ratio, height * ratio];
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return context;
}

// Return the matrix of a covariance given as xx, xy, xz, yy, yz, zz.
export function matrix([xx, xy, xz, yy, yz, zz]) {
  return [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
}

// Trace the outline of the ellipsoid of some deviations, with a least size in pixels.
export function ellipse(context, camera, place, covariance, deviations, smallest = 0) {
  const [across, down] = camera.jacobian(place);
  const product = (a, b) => {
    let sum = 0;
    for (let i = 0; i < 3; i += 1) for (let j = 0; j < 3; j += 1) sum += a[i] * covariance[i][j] * b[j];
    return sum;
  };
  const [a, b, c] = [product(across, across), product(across, down), product(down, down)];
  const mean = (a + c) / 2;
  const spread = Math.hypot((a - c) / 2, b);
  const large = Math.max(deviations * Math.sqrt(Math.max(mean + spread, 0)), smallest);
  const small = Math.max(deviations * Math.sqrt(Math.max(mean - spread, 0)), smallest);
  const [x, y] = camera.project(place);
  context.beginPath();
  context.ellipse(x, y, large, small, Math.atan2(2 * b, a - c) / 2, 0, 2 * Math.PI);
}

// Return points of a circle parallel to the ground.
export function circle([x, y, z = 0], radius, count = 48) {
  return Array.from({ length: count }, (_, index) => {
    const angle = (2 * Math.PI * index) / count;
    return [x + radius * Math.cos(angle), y + radius * Math.sin(angle), z];
  });
}

const SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];

// Draw the visible sides of a box.
export function box(context, camera, sides, fill, stroke) {
  for (let number = 0; number < SIDES.length; number += 1) side(context, camera, sides, number, fill, stroke);
}

// Draw one side of a box (west, east, south, north, bottom, top); return whether it is visible.
export function side(context, camera, sides, number, fill, stroke) {
  const points = SIDES[number].map((corner) => camera.project(sides.map((range, axis) => range[(corner >> (2 - axis)) & 1])));
  let area = 0;
  points.forEach(([x, y], index) => {
    const [nx, ny] = points[(index + 1) % 4];
    area += x * ny - nx * y;
  });
  if (area >= 0) return false;
  context.fillStyle = fill;
  context.strokeStyle = stroke;
  context.beginPath();
  points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.closePath();
  context.fill();
  context.stroke();
  return true;
}

export function cross(context, x, y, size) {
  context.beginPath();
  context.moveTo(x - size, y - size);
  context.lineTo(x + size, y + size);
  context.moveTo(x - size, y + size);
  context.lineTo(x + size, y - size);
  context.stroke();
}

// A line from a position to the ground, and its foot.
export function dropLine(context, camera, place, floor) {
  if (!camera.spatial) return;
  const foot = [place[0], place[1], floor];
  context.save();
  context.setLineDash([2, 3]);
  context.lineWidth = 1;
  context.globalAlpha *= 0.6;
  path(context, camera, [place, foot]);
  context.stroke();
  const [x, y] = camera.project(foot);
  context.fillStyle = context.strokeStyle;
  context.fillRect(x - 1.5, y - 1.5, 3, 3);
  context.restore();
}
