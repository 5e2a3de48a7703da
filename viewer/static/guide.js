// Guides the blade by mouse, touch and keys: they move the goal, and the hand follows it.

import { Plane, Quaternion, Raycaster, Vector2, Vector3 } from './vendor/three.module.min.js';

const PERIOD_MS = 1000 / 30;
const REACH = { mouse: 26, pen: 30, touch: 44 }; // [pixel] from the tool that still grip it
const STEP = 0.0005, LONG_STEP = 0.002; // [m] of a key, with Shift
const NOTCH = 0.0005; // [m] of a notch of the wheel
const ROTATION_STEP = Math.PI / 60; // of a key
const MAX_SLOPE = 0.82; // slope of the view above which an upright plane is no use
const SHOWN_DISTANCE = 0.0015; // [m] between tool and goal above which the goal is shown
const MAX_DRAG = 0.2; // [m] longest drag
const Z = new Vector3(0, 0, 1);
const KEYS = {
  ArrowLeft: ['right', -1], ArrowRight: ['right', 1], ArrowUp: ['ahead', 1], ArrowDown: ['ahead', -1],
  PageUp: ['up', 1], PageDown: ['up', -1],
};
const ROTATION_KEYS = {
  q: ['z', 1], e: ['z', -1], r: ['right', 1], f: ['right', -1], z: ['ahead', 1], x: ['ahead', -1],
};

export class Guide {
  /**
   * @param {HTMLElement} place around the canvas
   * @param {object} stage the drawn scene
   * @param {function} send takes position and wxyz
   */
  constructor(place, stage, send) {
    this._place = place;
    this._stage = stage;
    this._send = send;
    this.allowed = false;
    this.bounds = null;
    this.goal = null;
    this.level = false;
    this._drag = null;
    this._plane = new Plane();
    this._ray = new Raycaster();
    this._next = 0;
    this._timer = null;
    const on = (kind, take) => place.addEventListener(kind, take, { capture: true, passive: false });
    on('pointerdown', (event) => this._press(event));
    on('pointermove', (event) => this._move(event));
    on('pointerup', (event) => this._release(event));
    on('pointercancel', (event) => this._release(event));
    on('lostpointercapture', (event) => this._release(event));
    on('wheel', (event) => this._wheel(event));
    place.addEventListener('keydown', (event) => this._key(event));
  }

  get dragging() {
    return this._drag !== null;
  }

  /** Sets whether the hand follows goals, by the server; it ends a drag without effect. */
  allow(allowed) {
    if (this.allowed === allowed) return;
    this.allowed = allowed;
    if (!allowed) this.forget();
  }

  /** Sets the goal to the place of the tool. */
  forget() {
    this._drag = null;
    this.goal = null;
    clearTimeout(this._timer);
    this._timer = null;
    this.show();
  }

  /** Shows the goal where it differs from the place of the tool. */
  show() {
    const { moment, tool } = this._stage;
    const far = this.goal !== null && moment !== null
      && (this.dragging || this.goal.position.distanceTo(new Vector3().fromArray(moment.tip)) > SHOWN_DISTANCE);
    tool.showGoal(far ? this.goal : null);
    this._stage.invalidate();
  }

  /** Moves the goal along directions of the view: right, ahead (both level), up [m]. */
  shift(direction, by) {
    this._begin();
    if (this.goal === null) return;
    this._clamp(this.goal.position.addScaledVector(this._direction(direction), by));
    this._tell();
  }

  /** Rotates the goal about such a direction, or z [rad]. */
  turn(direction, by) {
    this._begin();
    if (this.goal === null) return;
    const turn = new Quaternion().setFromAxisAngle(this._direction(direction), by);
    this.goal.quaternion.premultiply(turn).normalize();
    this._tell();
  }

  _direction(name) {
    if (name === 'up' || name === 'z') return Z;
    const right = new Vector3().setFromMatrixColumn(this._stage.camera.matrixWorld, 0).setZ(0).normalize();
    return name === 'right' ? right : new Vector3().crossVectors(Z, right);
  }

  _begin() {
    const { moment } = this._stage;
    if (!this.allowed || moment === null) this.goal = null;
    else if (this.goal === null) {
      const [w, x, y, z] = moment.wxyz;
      this.goal = { position: new Vector3().fromArray(moment.tip), quaternion: new Quaternion(x, y, z, w) };
    }
  }

  _press(event) {
    if (this.dragging) {
      event.stopPropagation(); // a second finger rotates no view under the first
      return;
    }
    if (event.button !== 0 || !this._onTool(event)) return;
    this._begin();
    if (this.goal === null) return;
    event.stopPropagation();
    event.preventDefault();
    this._place.setPointerCapture(event.pointerId);
    this._drag = { pointer: event.pointerId, level: null };
    this._grip(event);
    this.show();
  }

  // The present pointer position belongs to the present goal: from here on both move together.
  _grip(event) {
    const level = this._isLevel(event);
    const from = this.goal.position.clone();
    const ahead = this._direction('ahead');
    this._plane.setFromNormalAndCoplanarPoint(level ? Z : ahead, from);
    Object.assign(this._drag, { level, from, x: event.clientX, y: event.clientY, at: this._hit(event) });
  }

  _isLevel(event) {
    const down = -this._stage.camera.getWorldDirection(new Vector3()).z;
    return this.level !== event.shiftKey || down > MAX_SLOPE;
  }

  _hit(event) {
    const box = this._stage.canvas.getBoundingClientRect();
    const place = new Vector2(
      (2 * (event.clientX - box.x)) / box.width - 1, 1 - (2 * (event.clientY - box.y)) / box.height,
    );
    this._ray.setFromCamera(place, this._stage.camera);
    return this._ray.ray.intersectPlane(this._plane, new Vector3());
  }

  _move(event) {
    if (!this.dragging) {
      this._place.classList.toggle('grip', this.allowed && this._onTool(event));
      return;
    }
    event.stopPropagation();
    if (event.pointerId !== this._drag.pointer) return;
    if (this._isLevel(event) !== this._drag.level) this._grip(event);
    const at = this._hit(event);
    if (at === null || this._drag.at === null) return;
    const moved = at.sub(this._drag.at).clampLength(0, MAX_DRAG);
    this._clamp(this.goal.position.copy(this._drag.from).add(moved));
    this._tell();
  }

  _release(event) {
    if (!this.dragging || event.pointerId !== this._drag.pointer) return;
    event.stopPropagation();
    this._drag = null;
    this.show();
  }

  _wheel(event) {
    if (!this.allowed || !(this.dragging || event.shiftKey)) return;
    event.stopPropagation();
    event.preventDefault();
    const way = Math.sign(event.deltaY || event.deltaX);
    this.shift('up', -way * NOTCH);
    if (this.dragging) this._drag.from.z -= way * NOTCH;
  }

  _key(event) {
    if (event.target !== this._place || event.ctrlKey || event.metaKey || event.altKey) return;
    const shift = KEYS[event.key], turn = ROTATION_KEYS[event.key.toLowerCase()];
    if (!this.allowed || (!shift && !turn)) return;
    event.preventDefault();
    if (shift) this.shift(shift[0], shift[1] * (event.shiftKey ? LONG_STEP : STEP));
    else this.turn(turn[0], turn[1] * ROTATION_STEP);
  }

  /** Whether a pointer is at the drawn tool, or at its goal. */
  _onTool(event) {
    const { tool, moment } = this._stage;
    if (moment === null) return false;
    const reach = REACH[event.pointerType] ?? REACH.mouse;
    const shown = tool.ghost.visible ? [tool.group, tool.ghost] : [tool.group];
    return shown.some((group) => {
      group.updateMatrixWorld();
      const tip = this._stage.project(group.position);
      const end = this._stage.project(tool.end.clone().applyMatrix4(group.matrixWorld));
      return tip.before && distance(event.clientX, event.clientY, tip, end) < reach;
    });
  }

  _clamp(position) {
    if (this.bounds === null) return;
    const { low, high } = this.bounds;
    position.clamp(new Vector3().fromArray(low), new Vector3().fromArray(high));
  }

  // At most thirty times a second; the last one always.
  _tell() {
    this.show();
    const now = performance.now();
    if (now < this._next) {
      this._timer ??= setTimeout(() => this._say(), this._next - now);
      return;
    }
    this._say();
  }

  _say() {
    clearTimeout(this._timer);
    this._timer = null;
    if (this.goal === null) return;
    this._next = performance.now() + PERIOD_MS;
    const { x, y, z, w } = this.goal.quaternion;
    this._send(this.goal.position.toArray(), [w, x, y, z]);
  }
}

/** Of a place from the line between two others [pixel]. */
function distance(x, y, a, b) {
  const dx = b.x - a.x, dy = b.y - a.y;
  const length = dx * dx + dy * dy || 1;
  const share = Math.min(1, Math.max(0, ((x - a.x) * dx + (y - a.y) * dy) / length));
  return Math.hypot(x - a.x - share * dx, y - a.y - share * dy);
}
