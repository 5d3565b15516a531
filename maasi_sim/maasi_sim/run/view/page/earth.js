// Geodetic coordinates of map positions (WGS 84).

const RADIUS = 6378137;
const SQUARED_ECCENTRICITY = 0.00669437999014;
const RADIANS = Math.PI / 180;

// Return earth-centred, earth-fixed coordinates [m].
function inSpace(longitude, latitude, altitude) {
  const normal = RADIUS / Math.sqrt(1 - SQUARED_ECCENTRICITY * Math.sin(latitude) ** 2);
  const level = (normal + altitude) * Math.cos(latitude);
  return [level * Math.cos(longitude), level * Math.sin(longitude), (normal * (1 - SQUARED_ECCENTRICITY) + altitude) * Math.sin(latitude)];
}

// Return east and north [m] from an origin, of longitude and latitude [radians] at its altitude.
function fromOrigin(position, { latitude, longitude, altitude }) {
  const [east, north] = [longitude * RADIANS, latitude * RADIANS];
  const centre = inSpace(east, north, altitude);
  const [a, b, c] = inSpace(...position, altitude).map((value, axis) => value - centre[axis]);
  const out = a * Math.cos(east) + b * Math.sin(east);
  return [b * Math.cos(east) - a * Math.sin(east), c * Math.cos(north) - out * Math.sin(north)];
}

// Return the map position [m] of longitude and latitude [degrees].
export function inMap(degrees, origin) {
  return fromOrigin(degrees.map((angle) => angle * RADIANS), origin);
}

// Return longitude and latitude [degrees] of a map position [m].
export function onEarth([x, y], origin) {
  let found = [origin.longitude * RADIANS, origin.latitude * RADIANS];
  const parallel = RADIUS * Math.cos(found[1]);
  // Each iteration reduces the error by 100.
  for (let round = 0; round < 8; round += 1) {
    const [right, up] = fromOrigin(found, origin);
    found = [found[0] + (x - right) / parallel, found[1] + (y - up) / RADIUS];
  }
  return found.map((angle) => Number((angle / RADIANS).toFixed(10)));
}
