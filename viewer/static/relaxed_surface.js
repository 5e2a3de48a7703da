// The surface as it lay before the tool touched it: what a pointer points at.
// The dent that the tool makes does not count, or a tool that follows it would sink by itself.

import { Vector3 } from './vendor/three.module.min.js';

const ABOVE = 1; // [m] from where the surface is looked for downwards
const FREE = 0; // contact of a moment
const UP = new Vector3(0, 0, 1);

export class RelaxedSurface {
  constructor() {
    this._parts = [];
    this._from = new Vector3();
  }

  /** Copies the geometries of a tissue, unless the tool touches it. */
  take(geometries, contact) {
    if (contact !== FREE && this._parts.length > 0) return;
    this._parts = geometries.filter((one) => one.index !== null).map((one, place) => ({
      at: copied(one.attributes.position.array, this._parts[place]?.at),
      normal: one.attributes.normal ? copied(one.attributes.normal.array, this._parts[place]?.normal) : null,
      faces: one.index.array,
    }));
  }

  /** The next tissue is another one. */
  forget() {
    this._parts = [];
  }

  /** @returns {{point, normal}|null} the first place on a ray of three */
  hit({ origin, direction }) {
    let best = null;
    for (const part of this._parts) best = nearest(part, origin, direction, best);
    if (best === null) return null;
    const { distance, part, face, u, v } = best;
    const point = origin.clone().addScaledVector(direction, distance);
    return { point, normal: normalAt(part, face, u, v) };
  }

  /** The first place of the surface on the line through a point, seen against a direction. */
  upright(point, up = UP) {
    return this.hit({ origin: this._from.copy(point).addScaledVector(up, ABOVE), direction: up.clone().negate() });
  }
}

function copied(array, into) {
  if (into?.length !== array.length) return array.slice();
  into.set(array);
  return into;
}

/** The nearest face on a ray, by Moeller and Trumbore (1997). */
function nearest(part, origin, direction, best) {
  const { at, faces } = part;
  const { x: ox, y: oy, z: oz } = origin, { x: dx, y: dy, z: dz } = direction;
  let least = best?.distance ?? Infinity;
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ax = at[a], ay = at[a + 1], az = at[a + 2];
    const ux = at[b] - ax, uy = at[b + 1] - ay, uz = at[b + 2] - az;
    const vx = at[c] - ax, vy = at[c + 1] - ay, vz = at[c + 2] - az;
    const px = dy * vz - dz * vy, py = dz * vx - dx * vz, pz = dx * vy - dy * vx;
    const volume = ux * px + uy * py + uz * pz;
    if (volume === 0) continue;
    const tx = ox - ax, ty = oy - ay, tz = oz - az;
    const u = (tx * px + ty * py + tz * pz) / volume;
    if (u < 0 || u > 1) continue;
    const qx = ty * uz - tz * uy, qy = tz * ux - tx * uz, qz = tx * uy - ty * ux;
    const v = (dx * qx + dy * qy + dz * qz) / volume;
    if (v < 0 || u + v > 1) continue;
    const distance = (vx * qx + vy * qy + vz * qz) / volume;
    if (distance <= 0 || distance >= least) continue;
    least = distance;
    best = { distance, part, face: f, u, v };
  }
  return best;
}

/** The outward normal; of a cut face upright, as the surface was there. */
function normalAt({ normal, faces }, face, u, v) {
  if (normal === null) return new Vector3(0, 0, 1);
  const [a, b, c] = [faces[face], faces[face + 1], faces[face + 2]];
  const mixed = (axis) => (1 - u - v) * normal[3 * a + axis] + u * normal[3 * b + axis] + v * normal[3 * c + axis];
  return new Vector3(mixed(0), mixed(1), mixed(2)).normalize();
}
