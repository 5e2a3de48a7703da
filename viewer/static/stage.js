// The scene in three dimensions. It is drawn once after each change.

import {
  DirectionalLight, HemisphereLight, PerspectiveCamera, Scene, Vector3, WebGLRenderer,
} from './vendor/three.module.min.js';
import { OrbitControls } from './vendor/OrbitControls.js';
import { Bridge, Ends, inkOf } from './exercise.js';
import { Floor } from './floor.js';
import { RelaxedSurface } from './relaxed_surface.js';
import { TipMarks } from './tip_marks.js';
import { TissueView } from './tissue.js';
import { Arrow, Proxy, Tool } from './tool.js';

const MAX_PIXEL_RATIO = 1.5;
const MIN_PIXEL_RATIO = 0.5; // of the full one
const SLOW_MS = 60, FAST_MS = 24; // delay of a picture
const REST_MS = 350; // without a change, after which a full picture is drawn
const NEAR = 0.02, FAR = 50; // of the distance of the first camera

/** Whether the browser draws without a graphics card. */
function drawsInSoftware() {
  const context = document.createElement('canvas').getContext('webgl2');
  if (context === null) return false;
  const known = context.getExtension('WEBGL_debug_renderer_info');
  const name = context.getParameter(known ? known.UNMASKED_RENDERER_WEBGL : context.RENDERER);
  context.getExtension('WEBGL_lose_context')?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(String(name));
}

export class Stage {
  /** @param {HTMLElement} place that the scene fills @param {string|null} quality high or low */
  constructor(place, quality) {
    this._place = place;
    const slow = quality === 'low' || (quality !== 'high' && drawsInSoftware());
    this.renderer = new WebGLRenderer({ antialias: !slow, alpha: true, powerPreference: 'high-performance' });
    this.renderer.setClearColor(0, 0);
    this._full = slow ? 1 : Math.min(window.devicePixelRatio, MAX_PIXEL_RATIO);
    this._ratio = this._full;
    this._adapts = quality === null;
    this.canvas = this.renderer.domElement;
    place.prepend(this.canvas);
    this.canvas.addEventListener('webglcontextrestored', () => this.invalidate());
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(50, 1, 0.005, 20);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener('change', () => this.invalidate());
    this.controls.zoomSpeed = 1.4;
    this._light();
    this.floor = new Floor(this.scene, !slow);
    this.tool = new Tool(this.scene);
    this.further = [];
    this.proxy = new Proxy(this.scene);
    this.arrow = new Arrow(this.scene);
    this.marks = new TipMarks(this.scene);
    this.ends = new Ends(this.scene);
    this.bridge = new Bridge(this.scene);
    this._ink = null;
    this._exercise = 'null'; // as text, to see whether it is another one
    this.surface = new RelaxedSurface();
    this._shown = null; // name of the tissue that the tool is in
    this.tissues = new Map();
    this.moment = null;
    this.frames = 0;
    this._asked = false;
    this._wait = 0;
    this._ratioDrawn = this._full;
    this._home = null;
    this._radius = 0.002;
    this._labels = [];
    new ResizeObserver(() => this._resize()).observe(place);
    this._resize();
  }

  _light() {
    this.scene.add(new HemisphereLight(0xfff6f2, 0x8a5a54, 1.55));
    const key = new DirectionalLight(0xfff2ea, 2.3);
    key.position.set(-0.5, -0.7, 1.2);
    const rim = new DirectionalLight(0xcfe6ff, 0.9);
    rim.position.set(0.8, 0.7, 0.35);
    this.scene.add(key, rim);
  }

  /** Applies the first message of a session. */
  begin(hello) {
    const names = hello.tissues.map((tissue) => tissue.name);
    for (const [name, tissue] of this.tissues) {
      if (names.includes(name)) continue;
      tissue.dispose();
      this.tissues.delete(name);
    }
    // Kept tissues keep their faces: the server does not send them again.
    for (const tissue of hello.tissues) this._tissue(tissue.name).look(tissue);
    this._shown = names[0];
    this._label(hello.tissues, this.ends.show(hello.exercise), hello.exercise?.lesion ?? null);
    this._inkTissues(hello.exercise);
    this.tool.equip(hello.tool);
    this._equipFurther(hello.further_tools);
    this._radius = hello.tool.radius;
    if (hello.camera !== null) this._frame(hello.camera);
    const centre = hello.camera?.target ?? [0, 0, 0];
    const least = 1.2 * this.camera.position.distanceTo(this.controls.target);
    const size = Math.max(hello.floor?.size ?? 0.3, hello.camera === null ? 0 : least);
    this.floor.lay({ z: hello.floor?.z ?? 0, size, centre });
    this._shade();
    this.invalidate();
  }

  _equipFurther(shapes) {
    for (const tool of this.further.splice(shapes.length)) tool.dispose(this.scene);
    shapes.forEach((shape, index) => {
      this.further[index] ??= new Tool(this.scene);
      this.further[index].equip(shape);
    });
  }

  _inkTissues(exercise) {
    const text = JSON.stringify(exercise);
    if (text !== this._exercise) {
      this._ink?.dispose();
      this._ink = inkOf(exercise);
    }
    this._exercise = text;
    for (const tissue of this.tissues.values()) tissue.draw(this._ink);
  }

  _tissue(name) {
    if (!this.tissues.has(name)) this.tissues.set(name, new TissueView(this.scene));
    return this.tissues.get(name);
  }

  _shade() {
    const boxes = [...this.tissues.values()].map((one) => one.box()).filter((box) => box !== null);
    this.floor.shade(boxes);
  }

  /** Moves the camera to the operator's place, unless it is the same as before. */
  _frame(camera) {
    const same = JSON.stringify(camera) === JSON.stringify(this._home);
    this._home = camera;
    const distance = new Vector3().fromArray(camera.position)
      .distanceTo(new Vector3().fromArray(camera.target));
    this.camera.near = NEAR * distance;
    this.camera.far = FAR * distance;
    this.controls.minDistance = 0.12 * distance;
    this.controls.maxDistance = 5 * distance;
    this._resize();
    if (same) return;
    for (const tissue of this.tissues.values()) tissue.forget();
    this.view('operator');
  }

  /** Places of the camera: operator, top, tool. */
  view(name) {
    if (this._home === null) return;
    const target = new Vector3().fromArray(this._home.target);
    const position = new Vector3().fromArray(this._home.position);
    const away = position.clone().sub(target);
    if (name === 'top') {
      position.copy(target).add(new Vector3(0, -0.002, 1).multiplyScalar(away.length()));
    } else if (name === 'tool' && this.moment !== null) {
      const near = new Vector3(away.x + 0.5 * away.length(), away.y, 0.55 * away.z);
      target.fromArray(this.moment.tip);
      position.copy(target).add(near.setLength(0.48 * away.length()));
    }
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.controls.update();
    this.invalidate();
  }

  /** Brings the camera nearer to its target by a factor. */
  zoom(factor) {
    const { target } = this.controls;
    this.camera.position.sub(target).divideScalar(factor).add(target);
    this.controls.update();
    this.invalidate();
  }

  takeMesh(mesh) {
    const tissue = this._tissue(mesh.name);
    const fresh = tissue.first === null;
    tissue.update(mesh);
    if (fresh) this._shade();
    if (mesh.name === this._shown) {
      if (fresh) this.surface.forget();
      this.surface.take(tissue.geometries, this.moment?.contact ?? 0);
      this._mark();
    }
    this.invalidate();
  }

  /** @param {number[]|null} place of the last tissue that holds the lesion */
  showBridge(place) {
    this.bridge.show(place);
    this.invalidate();
  }

  _mark() {
    if (this.moment === null) return;
    const { position, quaternion } = this.tool.group;
    this.marks.place(this.tool.bladeEnd.clone().applyQuaternion(quaternion).add(position), this.surface);
  }

  takeMoment(moment) {
    this.moment = moment;
    this.tool.place(moment);
    moment.further.forEach((place, index) => this.further[index]?.place(place));
    this.proxy.place(this._radius, moment.proxy);
    this.arrow.place(moment.tip, moment.force);
    this._mark();
    this.invalidate();
  }

  /** Window position of a point of the tissue frame [pixel], and whether it is before the camera. */
  project(point) {
    const place = new Vector3().copy(point).project(this.camera);
    const box = this.canvas.getBoundingClientRect();
    return {
      x: box.x + (0.5 + 0.5 * place.x) * box.width,
      y: box.y + (0.5 - 0.5 * place.y) * box.height,
      before: place.z < 1,
    };
  }

  /** Requests a picture with the display's next frame. */
  invalidate() {
    if (this._asked) return;
    this._asked = true;
    this._since = performance.now();
    requestAnimationFrame(() => this._draw());
  }

  _draw() {
    this._asked = false;
    if (this._ratioDrawn !== this._ratio) this.renderer.setPixelRatio(this._ratio);
    this._ratioDrawn = this._ratio;
    this.renderer.render(this.scene, this.camera);
    this._placeLabels();
    this.frames += 1;
    if (this._adapts) this._adapt(performance.now() - this._since);
  }

  // The delay of a requested picture measures the cost of the last one.
  _adapt(waited) {
    this._wait += 0.2 * (Math.min(waited, 300) - this._wait);
    if (this._wait > SLOW_MS) this._setRatio(0.75 * this._ratio);
    else if (this._wait < FAST_MS && this._ratio < this._full) this._setRatio(1.05 * this._ratio);
    clearTimeout(this._resting);
    if (this._ratio < this._full) this._resting = setTimeout(() => this._drawAtRest(), REST_MS);
  }

  _drawAtRest() {
    this.renderer.setPixelRatio(this._full);
    this.renderer.render(this.scene, this.camera);
    this.frames += 1;
    this._ratioDrawn = this._full;
  }

  _setRatio(wanted) {
    const ratio = Math.min(this._full, Math.max(MIN_PIXEL_RATIO * this._full, wanted));
    if (Math.abs(ratio - this._ratio) < 0.04 && ratio !== this._full) return;
    this._ratio = ratio;
    this._wait = 0.5 * (SLOW_MS + FAST_MS);
  }

  _resize() {
    const width = this._place.clientWidth, height = this._place.clientHeight;
    if (width === 0 || height === 0) return;
    this.renderer.setPixelRatio(this._ratioDrawn = this._ratio);
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    // In a narrow window the angle holds for its width.
    const half = Math.tan((this._home?.fov ?? 0.9) / 2) / Math.min(1, this.camera.aspect);
    this.camera.fov = (360 / Math.PI) * Math.atan(half);
    this.camera.updateProjectionMatrix();
    this.invalidate();
  }

  _label(tissues, ends, lesion) {
    for (const { element } of this._labels) element.remove();
    const below = ({ name }) => () => {
      const box = this.tissues.get(name)?.box() ?? null;
      return box && new Vector3((box.min.x + box.max.x) / 2, box.min.y, box.min.z);
    };
    const named = [
      ...tissues.filter(({ label }) => label).map((tissue) => ({ text: tissue.label, kind: 'below', at: below(tissue) })),
      ...ends.map(({ text, place }) => ({ text, kind: 'above', at: () => place.clone() })),
      ...(lesion === null ? [] : [{ text: 'still attached', kind: 'above', at: () => this.bridge.place }]),
    ];
    this._labels = named.map(({ text, kind, at }) => {
      const element = document.createElement('span');
      element.className = `label ${kind}`;
      element.textContent = text;
      this._place.append(element);
      return { element, at };
    });
  }

  _placeLabels() {
    for (const { element, at } of this._labels) {
      const place = at()?.project(this.camera) ?? null;
      element.hidden = place === null || place.z >= 1;
      if (element.hidden) continue;
      const x = (0.5 + 0.5 * place.x) * this._place.clientWidth;
      const y = (0.5 - 0.5 * place.y) * this._place.clientHeight;
      element.style.transform = `translate(${x}px, ${y}px)`;
    }
  }
}
