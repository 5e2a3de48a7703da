// The floor: a cloth with a grid of 1 cm and 5 cm, and a soft shadow under each tissue.

import {
  CanvasTexture, Group, LinearFilter, Mesh, MeshBasicMaterial, PlaneGeometry, SRGBColorSpace,
} from './vendor/three.module.min.js';

const PIXELS = 1024;
const CELL = 0.01, SECTION = 0.05; // [m]
const CLOTH = '47, 104, 112';

function canvas(size, fine, draw) {
  const element = document.createElement('canvas');
  element.width = element.height = size;
  draw(element.getContext('2d'), size);
  const texture = new CanvasTexture(element);
  texture.colorSpace = SRGBColorSpace;
  texture.anisotropy = fine ? 8 : 1;
  // Software rendering takes five times as long for a floor with mipmaps.
  texture.generateMipmaps = fine;
  if (!fine) texture.minFilter = LinearFilter;
  return texture;
}

function grid(context, pixels, metres) {
  const fade = context.createRadialGradient(
    pixels / 2, pixels / 2, 0.18 * pixels, pixels / 2, pixels / 2, pixels / 2,
  );
  fade.addColorStop(0, `rgba(${CLOTH}, 1)`);
  fade.addColorStop(1, `rgba(${CLOTH}, 0)`);
  context.fillStyle = fade;
  context.fillRect(0, 0, pixels, pixels);
  context.globalCompositeOperation = 'source-atop';
  const count = Math.round(metres / CELL);
  for (let i = 0; i <= count; i += 1) {
    const section = (i - count / 2) % Math.round(SECTION / CELL) === 0;
    context.fillStyle = section ? 'rgba(196, 232, 232, 0.62)' : 'rgba(170, 215, 215, 0.25)';
    const width = section ? 2.5 : 1.5;
    const at = (i / count) * pixels - width / 2;
    context.fillRect(at, 0, width, pixels);
    context.fillRect(0, at, pixels, width);
  }
}

function shadow(context, pixels) {
  const half = pixels / 2;
  const fade = context.createRadialGradient(half, half, 0.3 * half, half, half, half);
  fade.addColorStop(0, 'rgba(4, 16, 20, 0.62)');
  fade.addColorStop(0.55, 'rgba(4, 16, 20, 0.36)');
  fade.addColorStop(1, 'rgba(4, 16, 20, 0)');
  context.fillStyle = fade;
  context.fillRect(0, 0, pixels, pixels);
}

export class Floor {
  /** @param {object} scene @param {boolean} fine for a graphics card */
  constructor(scene, fine) {
    this._fine = fine;
    this._group = new Group();
    this._shadows = new Group();
    this._z = 0;
    scene.add(this._group, this._shadows);
  }

  /** @param {{z: number, size: number, centre: number[]}} floor all in metres */
  lay({ z, size, centre }) {
    this._z = z;
    for (const mesh of this._group.children) {
      mesh.geometry.dispose();
      mesh.material.map.dispose();
      mesh.material.dispose();
    }
    this._group.clear();
    const metres = 2 * SECTION * Math.ceil(size / (2 * SECTION));
    const map = canvas(PIXELS, this._fine, (context, pixels) => grid(context, pixels, metres));
    const cloth = plane(map, metres, metres);
    const snap = (value) => SECTION * Math.round(value / SECTION);
    cloth.position.set(snap(centre[0]), snap(centre[1]), z - 0.0004);
    cloth.renderOrder = -2;
    this._group.add(cloth);
  }

  /** A shadow below the box of a tissue, given by two corners. */
  shade(boxes) {
    for (const mesh of this._shadows.children) {
      mesh.geometry.dispose();
      mesh.material.dispose();
    }
    this._shadows.clear();
    this._soft ??= canvas(128, false, shadow);
    for (const { min, max } of boxes) {
      const mesh = plane(this._soft, 1.5 * (max.x - min.x), 1.5 * (max.y - min.y));
      mesh.position.set((min.x + max.x) / 2, (min.y + max.y) / 2, this._z - 0.0002);
      mesh.renderOrder = -1;
      this._shadows.add(mesh);
    }
  }
}

function plane(map, width, height) {
  const material = new MeshBasicMaterial({ map, transparent: true, depthWrite: false });
  return new Mesh(new PlaneGeometry(width, height), material);
}
