// The exercise in the picture: ink on the tissue, and rings where the tip begins and ends.

import {
  ATTACHED, BAND, BAND_EDGE, DOTS, ENDS, HATCH, LESION, TARGET, ZONE,
} from './colours.js';
import {
  CanvasTexture, Group, LinearFilter, Mesh, MeshBasicMaterial, SRGBColorSpace, TorusGeometry,
} from './vendor/three.module.min.js';

const DENSITY = 12000, MAX_PIXELS = 1024; // [1/m] pixels of the ink
const EDGE = 0.0004; // [m] line around an area
const DASH = 0.0032, GAP = 0.0018; // [m] of a target's line
const PATTERN = 0.0022; // [m] period of hatching and dots
const POINT = 1e-6; // [m] of the line that is drawn at a single place
const RING = 0.00025; // [m] radius of a ring's wire
const BRIDGE = 0.0028; // [m] radius of the ring around what holds a lesion

/**
 * The ink on the tissue, seen along z, as a texture by x and y at rest [m]; null: there is none.
 * Areas differ by pattern, not only by colour: band plain, zones hatched, lesion dotted.
 */
export function inkOf(exercise) {
  const lesions = exercise?.lesion ? [exercise.lesion] : [];
  const areas = exercise === null ? [] : [
    ...exercise.targets.map(({ points, margin }) => ({ points, radius: margin })),
    ...exercise.zones,
    ...lesions.map(({ centre, radius }) => ({ points: [centre], radius })),
  ];
  if (areas.length === 0) return null;
  const box = boxOf(areas);
  const scale = Math.min(DENSITY, MAX_PIXELS / Math.max(...box.size));
  const paper = new Paper(box, scale);
  const bands = areas.slice(0, exercise.targets.length);
  const zones = areas.slice(bands.length, bands.length + exercise.zones.length);
  paper.fill(bands, BAND_EDGE, [BAND]);
  paper.fill(zones, HATCH, [ZONE, paper.pattern(hatch, HATCH)]);
  paper.fill(areas.slice(bands.length + zones.length), DOTS, [LESION, paper.pattern(dots, DOTS)]);
  for (const { points, radius } of bands) paper.dash(points, 0.34 * radius);
  return paper.texture();
}

function boxOf(areas) {
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  for (const { points, radius } of areas) {
    for (const point of points) {
      for (const axis of [0, 1]) {
        low[axis] = Math.min(low[axis], point[axis] - radius - 4 * EDGE);
        high[axis] = Math.max(high[axis], point[axis] + radius + 4 * EDGE);
      }
    }
  }
  return { low, size: [high[0] - low[0], high[1] - low[1]] };
}

class Paper {
  constructor({ low, size }, scale) {
    this._low = low;
    this._size = size;
    this._scale = scale;
    [this._element, this._context] = sheet(...size.map((length) => Math.ceil(scale * length)));
    // Upright as the texture: y upwards.
    this._context.setTransform(scale, 0, 0, -scale, -scale * low[0], scale * (low[1] + size[1]));
    this._context.lineJoin = this._context.lineCap = 'round';
  }

  /** Fills areas around lines, a line around each union of them. */
  fill(areas, edge, styles) {
    const stroke = (wider, style) => {
      this._context.strokeStyle = style;
      for (const { points, radius } of areas) this._line(points, 2 * (radius + wider));
    };
    stroke(EDGE / 2, edge);
    this._context.globalCompositeOperation = 'destination-out';
    stroke(-EDGE / 2, '#000');
    this._context.globalCompositeOperation = 'source-over';
    for (const style of styles) stroke(-EDGE / 2, style);
  }

  dash(points, width) {
    this._context.lineCap = 'butt';
    this._context.setLineDash([DASH, GAP]);
    this._context.strokeStyle = TARGET;
    this._line(points, width);
    this._context.setLineDash([]);
    this._context.lineCap = 'round';
  }

  /** A pattern that `draw` draws on a square of side 1. */
  pattern(draw, colour) {
    const side = Math.max(4, Math.round(PATTERN * this._scale));
    const [element, context] = sheet(side, side);
    context.scale(side, side);
    context.strokeStyle = context.fillStyle = colour;
    draw(context);
    const pattern = this._context.createPattern(element, 'repeat');
    pattern.setTransform(new DOMMatrix().scale(1 / this._scale));
    return pattern;
  }

  texture() {
    const texture = new CanvasTexture(this._element);
    texture.colorSpace = SRGBColorSpace;
    texture.generateMipmaps = false; // slow in software
    texture.minFilter = LinearFilter;
    texture.anisotropy = 4;
    const [width, height] = this._size;
    texture.repeat.set(1 / width, 1 / height);
    texture.offset.set(-this._low[0] / width, -this._low[1] / height);
    return texture;
  }

  _line(points, width) {
    if (width <= 0) return;
    const context = this._context;
    const closed = points.length > 2 && points[0].every((value, axis) => value === points.at(-1)[axis]);
    context.lineWidth = width;
    context.beginPath();
    points.forEach(([x, y], index) => (index === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
    if (closed) context.closePath();
    else if (points.length === 1) context.lineTo(points[0][0] + POINT, points[0][1]);
    context.stroke();
  }
}

function sheet(width, height) {
  const element = document.createElement('canvas');
  [element.width, element.height] = [width, height];
  return [element, element.getContext('2d')];
}

function hatch(context) {
  context.lineWidth = 0.3;
  context.beginPath();
  for (const by of [-1, 0, 1]) {
    context.moveTo(by - 0.5, -0.5);
    context.lineTo(by + 1.5, 1.5);
  }
  context.stroke();
}

function dots(context) {
  context.beginPath();
  context.arc(0.5, 0.5, 0.22, 0, 2 * Math.PI);
  context.fill();
}

/** A ring around the last tissue that holds a lesion, seen through all else. */
export class Bridge {
  constructor(scene) {
    const material = new MeshBasicMaterial({ color: ATTACHED, depthTest: false, transparent: true });
    this._ring = new Mesh(new TorusGeometry(BRIDGE, BRIDGE / 8, 6, 32), material);
    this._ring.renderOrder = 4;
    this._ring.visible = false;
    scene.add(this._ring);
  }

  /** @param {number[]|null} place */
  show(place) {
    this._ring.visible = place !== null;
    if (place !== null) this._ring.position.fromArray(place);
  }

  /** Where its label is, null while there is none. */
  get place() {
    return this._ring.visible ? this._ring.position.clone() : null;
  }
}

/** Rings where the tip begins and ends, with their names. */
export class Ends {
  constructor(scene) {
    this._group = new Group();
    scene.add(this._group);
    this._material = new MeshBasicMaterial({ color: ENDS, transparent: true, opacity: 0.85 });
  }

  /** @returns {Array<{text: string, place: Vector3}>} labels, one for both where they are at one place */
  show(exercise) {
    for (const ring of this._group.children) ring.geometry.dispose();
    this._group.clear();
    const labels = [];
    for (const name of ['start', 'end']) {
      const ball = exercise?.[name];
      if (!ball) continue;
      const ring = new Mesh(new TorusGeometry(ball.radius, RING, 6, 48), this._material);
      ring.position.fromArray(ball.centre);
      this._group.add(ring);
      const same = labels.find(({ place }) => place.distanceTo(ring.position) < ball.radius);
      if (same) same.text += `, ${name}`;
      else labels.push({ text: name, place: ring.position.clone() });
    }
    return labels;
  }
}
