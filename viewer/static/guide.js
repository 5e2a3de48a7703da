// Guides the blade: it follows a pointer, keys or a gamepad over the tissue, and cuts while one is held.

import { Plane, Quaternion, Raycaster, Vector2, Vector3 } from './vendor/three.module.min.js';

const PERIOD_MS = 1000 / 30;
const REPEAT_MS = 500, REPEATS = 10; // of a goal after it was sent: it may be lost
const HEIGHT = 0.004, HEIGHTS = [-0.015, 0.03]; // [m] of the blade's end over the surface, without a cut
const DEPTH = 0.006, DEPTHS = [0, 0.03]; // [m] under it, in a cut
const NOTCH = 0.0005; // [m] of the wheel
const STEP = 0.0005, LONG_STEP = 0.002; // [m] of a key, with Shift
const ROTATION_STEP = Math.PI / 60; // of a key
const DOWN = 0.04, UP = 0.15, STROKE = 0.12; // [m/s] of the goal: down, up, along a cut
const PUSH_STEP = (DOWN * PERIOD_MS) / 1000, MAX_PUSH = 0.016; // [m] beyond the depth, until the blade goes in: hand and tissue yield
const NEAR = 0.005; // [m] beside the place of a cut from where the blade goes down
const FAR = 0.012, MAX_LIFT = 0.02; // [m] of a way from which the blade is lifted over the tissue
const BELOW_END = 0.002; // [m] that such a lift stays below the end of an exercise
const TURN = 4; // [rad/s] of the edge to the direction of a cut
const HEADING = 0.003; // [m] of a cut that make its direction
const MIN_SHARE = 0.1; // of the speed, while the edge does not face the stroke
const SHOWN_DISTANCE = 0.0015; // [m] between tool and goal above which the goal is shown
const FINGER = 56; // [pixel] that the blade is above a finger, which would hide it
const INSIDE = 2; // contact of a moment
const Z = new Vector3(0, 0, 1);
const KEYS = {
  ArrowLeft: ['right', -1], ArrowRight: ['right', 1], ArrowUp: ['ahead', 1], ArrowDown: ['ahead', -1],
  PageUp: ['up', 1], PageDown: ['up', -1],
};
const ROTATION_KEYS = {
  q: ['z', 1], e: ['z', -1], r: ['right', 1], f: ['right', -1], z: ['ahead', 1], x: ['ahead', -1],
};
const clamp = (value, [low, high]) => Math.min(high, Math.max(low, value));

export class Guide {
  /**
   * @param {HTMLElement} place around the canvas
   * @param {object} stage the drawn scene
   * @param {function} send takes position and wxyz
   * @param {function} changed called after a change of what `said` returns
   * @param {function} isOld returns whether the picture is old: nothing is cut then
   */
  constructor(place, stage, send, changed, isOld) {
    this._place = place;
    this._stage = stage;
    this._send = send;
    this._changed = changed;
    this._isOld = isOld;
    this.allowed = false;
    this.bounds = null;
    this.follows = true;
    this.byView = true; // whether right and ahead are those of the view, or of the tissue's axes
    this.height = HEIGHT;
    this.ceiling = Infinity;
    this.depth = DEPTH;
    this._cuts = new Set(); // what holds the cut
    this._finger = null;
    this._ray = new Raycaster();
    this.forget();
    const on = (kind, take) => place.addEventListener(kind, take, { capture: true, passive: false });
    on('pointerdown', (event) => this._press(event));
    on('pointermove', (event) => this._move(event));
    for (const kind of ['pointerup', 'pointercancel', 'lostpointercapture']) on(kind, (event) => this._release(event));
    on('wheel', (event) => this._wheel(event));
    window.addEventListener('keydown', (event) => this._key(event));
    window.addEventListener('keyup', (event) => {
      if (event.key.toLowerCase() === 'c') this.hold('key', false);
    });
    window.addEventListener('blur', () => {
      for (const by of ['key', 'pad', 'pointer']) this.hold(by, false);
    });
  }

  get cutting() {
    return this._cuts.size > 0;
  }

  /** Sets whether the hand follows goals, by the server; where not, nothing is held. */
  allow(allowed) {
    if (this.allowed === allowed) return;
    this.allowed = allowed;
    if (!allowed) this.forget();
  }

  /** Forgets goal and cut: the next motion begins where the tool is. */
  forget() {
    this._cuts.clear();
    this._finger = null;
    this.goal = null;
    this._aim = null; // place on the surface
    this._waiting = null; // that of a pointer, until the blade is out of the tissue
    this._path = []; // places of a cut that are still to be passed
    this._push = this._level = 0;
    this._repeats = 0;
    this._entered = false;
    this._heading = null;
    clearTimeout(this._timer);
    this._timer = null;
    this.show();
    this._changed();
  }

  /** Begins or ends a cut by one of those that can hold it: key, pointer, pad, latch. */
  hold(by, on) {
    if (on === this._cuts.has(by)) return;
    if (on && !this._begin()) return;
    const before = this.cutting;
    if (!before) this._follow();
    if (on) this._cuts.add(by);
    else this._cuts.delete(by);
    if (this.cutting === before) return;
    if (!this.cutting) {
      this._waiting = this._path.at(-1) ?? null;
      this._path = [];
      this._push = 0;
    } else if (this._waiting !== null) { // the blade is still in the tissue
      this._path = [this._waiting];
      this._waiting = null;
    }
    this._entered = false;
    this._heading = this.cutting ? this._aim.clone() : null;
    this._changed();
    this._soon();
  }

  /** Shows the goal where it differs from the place of the tool. */
  show() {
    const { moment, tool } = this._stage;
    const far = this.goal !== null && moment !== null
      && this.goal.position.distanceTo(new Vector3().fromArray(moment.tip)) > SHOWN_DISTANCE;
    tool.showGoal(far ? this.goal : null);
    this._stage.invalidate();
  }

  /** Moves the goal along a direction of the view, right or ahead, over the surface; or up [m]. */
  shift(direction, by) {
    if (!this._begin()) return;
    if (direction === 'up') {
      this.raise(by);
      return;
    }
    const point = (this._path.at(-1) ?? this._waiting ?? this._aim).clone().addScaledVector(this._direction(direction), by);
    this._aimAt(this._stage.surface.upright(point)?.point ?? point);
  }

  /** Changes the height, or in a cut the depth [m]. */
  raise(by) {
    if (!this._begin()) return;
    if (this.cutting) this.depth = clamp(this.depth - by, DEPTHS);
    else this.height = clamp(this.height + by, HEIGHTS);
    this._changed();
    this._soon();
  }

  /** Rotates the goal about such a direction, or z [rad]. */
  turn(direction, by) {
    if (!this._begin()) return;
    this.goal.quaternion.premultiply(new Quaternion().setFromAxisAngle(this._direction(direction), by)).normalize();
    this._soon();
  }

  _direction(name) {
    if (name === 'z') return Z;
    const right = this.byView
      ? new Vector3().setFromMatrixColumn(this._stage.camera.matrixWorld, 0).setZ(0).normalize()
      : new Vector3(1, 0, 0);
    return name === 'right' ? right : new Vector3().crossVectors(Z, right);
  }

  /** Returns whether there is a goal; the first one is where the tool is, or at a height [m]. */
  _begin(height = null) {
    const { moment, surface } = this._stage;
    if (!this.allowed || moment === null) return false;
    if (this.goal !== null) return true;
    const [w, x, y, z] = moment.wxyz;
    this.goal = { position: new Vector3().fromArray(moment.tip), quaternion: new Quaternion(x, y, z, w) };
    const end = this.goal.position.clone().add(this._toEnd());
    const up = this._handle();
    this._aim = surface.upright(end, up)?.point ?? end.clone().addScaledVector(up, -end.z);
    this._level = clamp(end.clone().sub(this._aim).dot(up), HEIGHTS);
    this.height = height ?? this._level;
    return true;
  }

  /** The direction up the handle, along which the blade goes in: a flap that hangs turns its normal. */
  _handle() {
    return Z.clone().applyQuaternion(this.goal.quaternion);
  }

  /** From the tool's position to the end of its blade. */
  _toEnd() {
    return this._stage.tool.bladeEnd.clone().applyQuaternion(this.goal.quaternion);
  }

  // Pointers

  _press(event) {
    if (this._finger !== null && event.pointerId !== this._finger) {
      event.stopPropagation(); // a second finger rotates no view under the first: it cuts
      this.hold('pointer', true);
      return;
    }
    if (event.button !== 0 || !this.allowed || !this.follows) return;
    const hit = this._hit(event, 0);
    if (hit === null || !this._begin(HEIGHT)) return;
    event.stopPropagation();
    this._place.setPointerCapture(event.pointerId);
    this._finger = event.pointerId;
    const isFinger = event.pointerType === 'touch';
    this._aimAt(isFinger ? this._hit(event) ?? hit : hit);
    if (!isFinger) this.hold('pointer', true);
  }

  _move(event) {
    const steers = event.pointerId === this._finger;
    if (this._finger !== null) event.stopPropagation();
    if (!this.allowed || !this.follows || !(steers || (this._finger === null && event.buttons === 0 && event.pointerType !== 'touch'))) return;
    const hit = this._hit(event) ?? (this.cutting && steers ? this._beside(event) : null);
    this._place.classList.toggle('aims', hit !== null);
    if (hit !== null && this._begin(HEIGHT)) this._aimAt(hit);
  }

  _release(event) {
    if (this._finger === null) return;
    event.stopPropagation();
    this.hold('pointer', false);
    if (event.pointerId === this._finger) this._finger = null;
  }

  _wheel(event) {
    if (!this.allowed || !this.follows || event.ctrlKey || (this._finger === null && this._hit(event, 0) === null)) return;
    event.stopPropagation();
    event.preventDefault();
    this.raise(-Math.sign(event.deltaY || event.deltaX) * NOTCH);
  }

  /** The place of the tissue under a pointer, or null. */
  _hit(event, above = event.pointerType === 'touch' ? FINGER : 0) {
    const box = this._stage.canvas.getBoundingClientRect();
    const x = (2 * (event.clientX - box.x)) / box.width - 1, y = 1 - (2 * (event.clientY - above - box.y)) / box.height;
    this._ray.setFromCamera(new Vector2(x, y), this._stage.camera);
    return this._stage.surface.hit(this._ray.ray)?.point ?? null;
  }

  /** Beside the tissue a cut goes on at the same height, so that it can leave through an edge. */
  _beside(event) {
    this._hit(event); // aims the ray
    const last = this._path.at(-1) ?? this._aim;
    const plane = new Plane().setFromNormalAndCoplanarPoint(Z, last);
    const point = this._ray.ray.intersectPlane(plane, new Vector3());
    return point === null || point.distanceTo(last) > 5 * FAR ? null : point;
  }

  // Keys

  _key(event) {
    const tag = event.target.tagName;
    if (event.ctrlKey || event.metaKey || event.altKey || tag === 'SELECT' || tag === 'INPUT' || !this.allowed) return;
    const key = event.key.toLowerCase();
    if (key === 'c') {
      if (!event.repeat) this.hold('key', true);
      return;
    }
    if (event.target !== this._place) return;
    const shift = KEYS[event.key], turn = ROTATION_KEYS[key];
    if (!shift && !turn) return;
    event.preventDefault();
    if (shift) this.shift(shift[0], shift[1] * (event.shiftKey ? LONG_STEP : STEP));
    else this.turn(turn[0], turn[1] * ROTATION_STEP);
  }

  /** No lift on the way ends an attempt: the tip is back at the end of an exercise by a hand alone. */
  begin({ bounds, exercise }) {
    this.bounds = bounds ?? null;
    this.ceiling = exercise?.end ? exercise.end.centre[2] - exercise.end.radius - BELOW_END : Infinity;
  }

  // From the aim to the goal

  _aimAt(hit) {
    if (this.cutting) this._path.push(hit);
    else this._waiting = hit;
    this._soon();
  }

  // At most thirty times a second; the first one at once.
  _soon() {
    const wait = (this._next ?? 0) - performance.now();
    if (wait <= 0) this._advance();
    else this._timer ??= setTimeout(() => this._advance(), wait);
  }

  _advance() {
    clearTimeout(this._timer);
    this._timer = null;
    const now = performance.now(), { moment } = this._stage;
    const dt = Math.min(0.1, Math.max(0.001, (now - (this._last ?? now - PERIOD_MS)) / 1000));
    this._last = now;
    if (this.goal === null || moment === null) return;
    this._next = now + PERIOD_MS;
    if (this.cutting && this._isOld()) { // whether the blade is in is not known
      this._timer = setTimeout(() => this._advance(), PERIOD_MS);
      return;
    }
    const end = new Vector3().fromArray(moment.tip).add(this._toEnd());
    if (!this.cutting) this._follow();
    const wanted = this._wanted();
    const way = Math.hypot(end.x - wanted.x, end.y - wanted.y);
    const sinks = this._down(dt, way, moment);
    const moves = this._along(dt) || sinks || way > FAR || this._waiting !== null;
    const goal = this.goal.position.copy(this._wanted()).sub(this._toEnd());
    if (!this.cutting) goal.z += clamp(Math.min(way - FAR, this.ceiling - goal.z), [0, MAX_LIFT]);
    this._bound(this.goal.position);
    this._say();
    this.show();
    if (moves || this._repeats > 0) this._timer ??= setTimeout(() => this._advance(), PERIOD_MS);
  }

  /** Follows the pointer, unless the blade is in the tissue: it comes out where it is. */
  _follow() {
    if (this._waiting === null || this._level < Math.min(0, this.height)) return;
    this._aim = this._waiting;
    this._waiting = null;
  }

  /** Where the end of the blade is to be. */
  _wanted() {
    return this._aim.clone().addScaledVector(this._handle(), this._level);
  }

  /** Moves the level to that of the cut, or of the height; returns whether it goes on. */
  _down(dt, way, moment) {
    if (this.cutting && way > NEAR && this._level > 0 && this._push === 0) return true; // not there yet
    const wanted = this.cutting ? -this.depth - this._push : this.height;
    const step = clamp(wanted - this._level, [-DOWN * dt, UP * dt]);
    this._level += step;
    if (!this.cutting) return Math.abs(wanted - this._level) > 1e-6;
    this._entered ||= moment.contact === INSIDE;
    // A step for each moment, which says whether the blade is in: where they come late it is pushed slower.
    const news = moment !== this._seen;
    this._seen = moment;
    if (this._entered || !this._stage.tool.cuts) this._push = 0;
    else if (news && this._level - wanted < 1e-9) this._push = clamp(this._push + PUSH_STEP, [0, MAX_PUSH]);
    return true;
  }

  /** Follows the path of a cut, the edge ahead; returns whether it goes on. */
  _along(dt) {
    if (!this.cutting) return false;
    // The blade waits where it goes in.
    const goes = this._entered || this._push === MAX_PUSH || !this._stage.tool.cuts;
    let left = goes ? STROKE * dt * this._head(dt) : 0;
    while (this._path.length > 0 && left > 0) {
      const next = this._path[0], far = next.distanceTo(this._aim);
      const share = Math.min(1, left / Math.max(far, 1e-12));
      this._aim = this._aim.clone().lerp(next, share);
      if (share === 1) this._path.shift();
      left -= far;
    }
    return this._path.length > 0;
  }

  /** Turns the edge to the stroke, as a hand does; returns the share of the speed until it faces it. */
  _head(dt) {
    const { facing } = this._stage.tool;
    const ahead = this._path.find((point) => point.distanceTo(this._aim) > HEADING) ?? this._aim;
    const way = ahead.clone().sub(this._heading).setZ(0);
    const length = way.length();
    if (facing.lengthSq() === 0 || length < HEADING) return 1;
    this._heading.addScaledVector(this._aim.clone().sub(this._heading), 1 - HEADING / length);
    const edge = facing.clone().applyQuaternion(this.goal.quaternion);
    const angle = Math.atan2(edge.x * way.y - edge.y * way.x, edge.x * way.x + edge.y * way.y);
    const turn = new Quaternion().setFromAxisAngle(Z, clamp(angle, [-TURN * dt, TURN * dt]));
    this.goal.quaternion.premultiply(turn).normalize();
    return Math.max(MIN_SHARE, Math.cos(angle));
  }

  _bound(position) {
    if (this.bounds === null) return;
    const { low, high } = this.bounds;
    position.clamp(new Vector3().fromArray(low), new Vector3().fromArray(high));
  }

  _say() {
    const { x, y, z, w } = this.goal.quaternion;
    const told = [...this.goal.position.toArray(), w, x, y, z];
    const same = this._told?.every((value, i) => Math.abs(value - told[i]) < 1e-7);
    const now = performance.now();
    if (same && (this._repeats === 0 || now - this._toldAt < REPEAT_MS)) return;
    this._repeats = same ? this._repeats - 1 : REPEATS;
    this._told = told;
    this._toldAt = now;
    this._send(told.slice(0, 3), told.slice(3));
  }
}
