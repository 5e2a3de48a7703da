// Below the tip: its shadow on the surface, and a line between both that shows height or depth.

import { fadedTexture } from './faded_texture.js';
import {
  CylinderGeometry, Group, Mesh, MeshBasicMaterial, PlaneGeometry, RingGeometry, Vector3,
} from './vendor/three.module.min.js';

const ABOVE = 0xe8f1f8, BELOW = 0xffd166;
const RADIUS = 0.0003; // [m] of the line
const TICK = 0.005, TICK_SIDE = 0.0012; // [m] between two marks of the line, and their radius
const MAX_TICKS = 8;
const MIN_SHADOW = 0.004, GROWTH = 0.35; // [m] of the shadow's radius, and its growth by height
const LIFT = 0.0005; // [m] over the surface
const Y = new Vector3(0, 1, 0), Z = new Vector3(0, 0, 1);

export class TipMarks {
  constructor(scene) {
    this._group = new Group();
    this._group.visible = false;
    const over = { depthTest: false, depthWrite: false, transparent: true };
    this._line = new Mesh(new CylinderGeometry(1, 1, 1, 8), new MeshBasicMaterial({ ...over, opacity: 0.85 }));
    this._ticks = Array.from({ length: MAX_TICKS }, () => new Mesh(new CylinderGeometry(TICK_SIDE, TICK_SIDE, 2 * RADIUS, 12), this._line.material));
    this._ring = new Mesh(new RingGeometry(0.0015, 0.0021, 32), new MeshBasicMaterial({ ...over, opacity: 0.9 }));
    const soft = new MeshBasicMaterial({ map: softDisc(), depthWrite: false, transparent: true });
    soft.polygonOffset = true;
    soft.polygonOffsetFactor = soft.polygonOffsetUnits = -4;
    this._shadow = new Mesh(new PlaneGeometry(2, 2), soft);
    this._line.renderOrder = this._ring.renderOrder = 4;
    for (const tick of this._ticks) tick.renderOrder = 4;
    this._group.add(this._line, this._ring, this._shadow, ...this._ticks);
    scene.add(this._group);
    this.height = null; // [m] of the end over the surface, null beside the tissue
  }

  /** @param {Vector3} end of the blade @param {object} surface */
  place(end, surface) {
    const foot = surface.upright(end);
    this._group.visible = foot !== null;
    this.height = foot === null ? null : end.z - foot.point.z;
    if (foot === null) return;
    const { point, normal } = foot;
    const colour = this.height < 0 ? BELOW : ABOVE;
    this._line.material.color.set(colour);
    this._ring.material.color.set(colour);
    this._line.position.copy(point).lerp(end, 0.5);
    this._line.quaternion.setFromUnitVectors(Y, Z);
    this._line.scale.set(RADIUS, Math.max(1e-6, Math.abs(this.height)), RADIUS);
    this._ticks.forEach((tick, index) => {
      const at = (index + 1) * TICK;
      tick.visible = at < Math.abs(this.height);
      tick.position.copy(point).setZ(point.z + Math.sign(this.height) * at);
      tick.quaternion.copy(this._line.quaternion);
    });
    for (const flat of [this._ring, this._shadow]) {
      flat.position.copy(point).addScaledVector(normal, LIFT);
      flat.quaternion.setFromUnitVectors(Z, normal);
    }
    const above = Math.max(0, this.height);
    this._shadow.scale.setScalar(MIN_SHADOW + GROWTH * above);
    this._shadow.material.opacity = 0.75 / (1 + 60 * above);
  }
}

function softDisc() {
  return fadedTexture(64, 64, (context) => context.createRadialGradient(32, 32, 0, 32, 32, 32), [
    [0, 'rgba(10, 2, 4, 0.9)'], [0.5, 'rgba(10, 2, 4, 0.5)'], [1, 'rgba(10, 2, 4, 0)'],
  ]);
}
