// Projection from the map [m] to the canvas [px]: from above, or in 3D with an orbit camera.

export class Camera {
  constructor() {
    this.spatial = false;
    this.centre = [0, 0, 0];
    this.scale = 1;
    this.turn = -0.6;
    this.tilt = 0.55;
    this.width = 1;
    this.height = 1;
    this.update();
  }

  // Show all of the environment.
  fit(bounds) {
    const size = bounds.map(([low, high]) => high - low);
    this.centre = [0, 1, 2].map((axis) => (bounds[axis] ? (bounds[axis][0] + bounds[axis][1]) / 2 : 0));
    this.distance = 3 * Math.hypot(...size);
    const [wide, high] = [this.width - 40, this.height - 50];
    if (this.spatial) {
      this.update();
      this.scale = 1;
      const reach = [1e-6, 1e-6];
      for (const x of bounds[0]) {
        for (const y of bounds[1]) {
          for (const z of bounds[2] || [0]) {
            const [px, py] = this.project([x, y, z]);
            reach[0] = Math.max(reach[0], Math.abs(px - this.width / 2));
            reach[1] = Math.max(reach[1], Math.abs(py - this.height / 2));
          }
        }
      }
      this.scale = Math.min(wide / (2 * reach[0]), high / (2 * reach[1]));
    } else {
      this.scale = Math.max(Math.min(wide / size[0], high / size[1]), 1e-6);
    }
    this.update();
  }

  update() {
    this.cosTurn = Math.cos(this.turn);
    this.sinTurn = Math.sin(this.turn);
    this.cosTilt = Math.cos(this.tilt);
    this.sinTilt = Math.sin(this.tilt);
  }

  // Return x and y [px], and the depth: larger is farther [m].
  project(place) {
    const x = place[0] - this.centre[0];
    const y = place[1] - this.centre[1];
    if (!this.spatial) return [this.width / 2 + x * this.scale, this.height / 2 - y * this.scale, 0];
    const z = (place[2] || 0) - this.centre[2];
    const right = x * this.cosTurn - y * this.sinTurn;
    const away = x * this.sinTurn + y * this.cosTurn;
    const up = z * this.cosTilt + away * this.sinTilt;
    const depth = away * this.cosTilt - z * this.sinTilt;
    const shrink = this.distance / Math.max(this.distance + depth, 0.05 * this.distance);
    return [
      this.width / 2 + right * this.scale * shrink,
      this.height / 2 - up * this.scale * shrink,
      depth,
    ];
  }

  // Return the derivative of the picture by each axis: two rows of three [px/m].
  jacobian(place) {
    const step = 1e-3 * (this.distance || 1);
    const [x, y] = this.project(place);
    const rows = [[], []];
    for (let axis = 0; axis < 3; axis += 1) {
      const moved = [place[0], place[1], place[2] || 0];
      moved[axis] += step;
      const [mx, my] = this.project(moved);
      rows[0].push((mx - x) / step);
      rows[1].push((my - y) / step);
    }
    return rows;
  }

  // Return the position on the plane z = 0 at a point of the canvas, from above only.
  place(x, y) {
    return [
      this.centre[0] + (x - this.width / 2) / this.scale,
      this.centre[1] - (y - this.height / 2) / this.scale,
    ];
  }

  // Return the position at a height at a point of the canvas.
  ground(x, y, height) {
    if (!this.spatial) return this.place(x, y);
    // A point of the ray at a depth d is right = a (D + d), up = b (D + d), with D the distance of the eye.
    const [a, b] = [(x - this.width / 2) / (this.scale * this.distance), (this.height / 2 - y) / (this.scale * this.distance)];
    const z = height - this.centre[2];
    // From up = z cos + away sin, and d = away cos - z sin.
    const slope = this.sinTilt - b * this.cosTilt;
    const away = (b * (this.distance - z * this.sinTilt) - z * this.cosTilt) / slope;
    const right = a * (this.distance + away * this.cosTilt - z * this.sinTilt);
    return [this.centre[0] + right * this.cosTurn + away * this.sinTurn, this.centre[1] - right * this.sinTurn + away * this.cosTurn];
  }

  drag(dx, dy) {
    if (this.spatial) {
      this.turn -= 0.008 * dx;
      this.tilt = Math.min(Math.max(this.tilt + 0.008 * dy, 0.02), Math.PI / 2);
    } else {
      this.centre[0] -= dx / this.scale;
      this.centre[1] += dy / this.scale;
    }
    this.update();
  }

  zoom(factor, x, y) {
    if (this.spatial) {
      this.scale *= factor;
      return;
    }
    const before = this.place(x, y);
    this.scale *= factor;
    const after = this.place(x, y);
    this.centre[0] += before[0] - after[0];
    this.centre[1] += before[1] - after[1];
  }
}
