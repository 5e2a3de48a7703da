// Tool, proxy and force as they are drawn.

import { BLADE, FORCE, GHOST, HANDLE, PROXY } from './colours.js';
import {
  BufferAttribute, BufferGeometry, ConeGeometry, CylinderGeometry, Group, Mesh,
  MeshBasicMaterial, MeshPhongMaterial, SphereGeometry, Vector3,
} from './vendor/three.module.min.js';

const METRES_PER_NEWTON = 0.02;
const MIN_FORCE = 0.02; // [N] below which no arrow is drawn
const SHAFT = 0.0009, HEAD = 0.0024, HEAD_LENGTH = 0.006; // [m]
const UP = new Vector3(0, 1, 0); // of three's cylinders

function solid({ vertices, faces }, material) {
  const geometry = new BufferGeometry();
  geometry.setAttribute('position', new BufferAttribute(new Float32Array(vertices.flat()), 3));
  geometry.setIndex(faces.flat());
  geometry.computeVertexNormals();
  return new Mesh(geometry, material);
}

/** Blade and handle, and a point at the handle's far end. */
export class Tool {
  constructor(scene) {
    this.group = new Group();
    this.group.visible = false;
    this.ghost = new Group();
    this.ghost.visible = false;
    this.end = new Vector3(0, 0, 0.1);
    this.bladeEnd = new Vector3();
    this.facing = new Vector3();
    this.cuts = true; // else it presses only
    scene.add(this.group, this.ghost);
  }

  equip(tool) {
    const looks = [
      [tool.blade, { color: BLADE, specular: 0xffffff, shininess: 90, flatShading: true }],
      [tool.handle, { color: HANDLE, specular: 0x55606c, shininess: 40 }],
    ];
    const ghostly = { color: GHOST, transparent: true, opacity: 0.38, depthWrite: false };
    for (const group of [this.group, this.ghost]) empty(group);
    for (const [shape, look] of looks) {
      this.group.add(solid(shape, new MeshPhongMaterial(look)));
      this.ghost.add(solid(shape, new MeshBasicMaterial(ghostly)));
    }
    this.bladeEnd.fromArray(tool.blade_tip);
    this.facing.fromArray(tool.blade_facing);
    this.cuts = tool.cuts;
    this.end.set(0, 0, 0);
    for (const corner of tool.handle.vertices) {
      const [x, y, z] = corner;
      if (Math.hypot(x, y, z) > this.end.length()) this.end.set(x, y, z);
    }
  }

  /** @param {object|null} moment null: it is not known where it is */
  place(moment) {
    if (moment === null) this.group.visible = false;
    else put(this.group, moment.tip, moment.wxyz);
  }

  /** Takes it out of the scene for good. */
  dispose(scene) {
    for (const group of [this.group, this.ghost]) {
      empty(group);
      scene.remove(group);
    }
  }

  showGoal(goal) {
    this.ghost.visible = goal !== null;
    if (goal === null) return;
    this.ghost.position.copy(goal.position);
    this.ghost.quaternion.copy(goal.quaternion);
  }
}

function put(object, position, [w, x, y, z]) {
  object.visible = true;
  object.position.fromArray(position);
  object.quaternion.set(x, y, z, w);
}

function empty(group) {
  for (const mesh of group.children) {
    mesh.geometry.dispose();
    mesh.material.dispose();
  }
  group.clear();
}

/** The sphere at the place of the proxy on the surface. */
export class Proxy {
  constructor(scene) {
    const look = { color: PROXY, transparent: true, opacity: 0.55, depthWrite: false };
    this.ball = new Mesh(new SphereGeometry(1, 24, 16), new MeshPhongMaterial(look));
    this.ball.visible = false;
    scene.add(this.ball);
  }

  place(radius, position) {
    this.ball.visible = position !== null;
    this.ball.scale.setScalar(radius);
    if (position !== null) this.ball.position.fromArray(position);
  }
}

/** The force on the hand. */
export class Arrow {
  constructor(scene) {
    const material = new MeshPhongMaterial({ color: FORCE, emissive: 0x1d5c82, shininess: 20, depthTest: false });
    const shaft = new CylinderGeometry(1, 1, 1, 16);
    shaft.translate(0, 0.5, 0);
    const head = new ConeGeometry(HEAD, HEAD_LENGTH, 20);
    head.translate(0, HEAD_LENGTH / 2, 0);
    this._shaft = new Mesh(shaft, material);
    this._head = new Mesh(head, material);
    this._group = new Group();
    // Over everything: the force matters most where tissue hides the tip.
    this._shaft.renderOrder = this._head.renderOrder = 5;
    this._group.add(this._shaft, this._head);
    this._group.visible = false;
    this._along = new Vector3();
    scene.add(this._group);
  }

  place(tip, force) {
    const norm = this._along.fromArray(force).length();
    this._group.visible = norm >= MIN_FORCE;
    if (!this._group.visible) return;
    this._group.position.fromArray(tip);
    this._group.quaternion.setFromUnitVectors(UP, this._along.divideScalar(norm));
    const length = METRES_PER_NEWTON * norm;
    const head = Math.min(1, length / HEAD_LENGTH);
    this._shaft.scale.set(SHAFT, Math.max(1e-6, length - head * HEAD_LENGTH), SHAFT);
    this._head.scale.setScalar(head);
    this._head.position.set(0, length - head * HEAD_LENGTH, 0);
  }
}
