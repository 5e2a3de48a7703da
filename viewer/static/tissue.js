// One tissue in the scene: its outside, the cut faces, and a band of blood along the edges of the cuts.

import { BLOOD, CORE, FAT, OPENED } from './colours.js';
import { fadedTexture } from './faded_texture.js';
import {
  Box3, BufferAttribute, BufferGeometry, DynamicDrawUsage, Group, Mesh, MeshBasicMaterial,
  MeshPhongMaterial, SRGBColorSpace,
} from './vendor/three.module.min.js';

const CORE_RADIUS = 0.0006; // [m]
const BAND = 0.0026; // [m] half the width of the blood beside a cut
const RIM = 0.0012, DEEP = 0.012; // [m] under the edge of a cut: thickness of the rim, the darkest

export class TissueView {
  constructor(scene) {
    this.group = new Group();
    const looks = {
      outer: { vertexColors: true, specular: 0x4a3a38, shininess: 46 },
      cut: { color: OPENED, vertexColors: true, specular: 0xa07070, shininess: 90, flatShading: true, side: 2 },
    };
    this.parts = {};
    for (const [kind, look] of Object.entries(looks)) {
      const mesh = new Mesh(new BufferGeometry(), new MeshPhongMaterial(look));
      mesh.frustumCulled = false;
      mesh.visible = false;
      this.group.add(mesh);
      this.parts[kind] = mesh;
    }
    this.parts.outer.material.onBeforeCompile = inked;
    this.cutEdges = new Mesh(new BufferGeometry(), new MeshBasicMaterial({ color: CORE }));
    const wet = { color: BLOOD, specular: 0xffffff, shininess: 120, map: fadedBand(), transparent: true, depthWrite: false, side: 2 };
    this.blood = new Mesh(new BufferGeometry(), new MeshPhongMaterial(wet));
    for (const mesh of [this.blood, this.cutEdges]) {
      mesh.frustumCulled = false;
      this.group.add(mesh);
    }
    this.first = null;
    this.revision = -1;
    scene.add(this.group);
    this._scene = scene;
  }

  /** Takes colour, 0 to 255, and place. */
  look({ colour, offset }) {
    this.parts.outer.material.color.setRGB(...colour.map((share) => share / 255), SRGBColorSpace);
    this.group.position.fromArray(offset);
  }

  /** Takes the ink on the outside, a texture by x and y at rest; null: none. */
  draw(ink) {
    const { material } = this.parts.outer;
    material.map = ink;
    material.needsUpdate = true;
  }

  /** The next positions are those of the whole tissue. */
  forget() {
    this.first = null;
  }

  /** The box of the whole tissue where it stands, or null. */
  box() {
    return this.first === null ? null : this.first.clone().translate(this.group.position);
  }

  /** Updates positions, and faces where there are new ones. */
  update(mesh) {
    this.revision = mesh.revision;
    for (const [kind, part] of Object.entries(mesh.parts)) this._part(kind, part, mesh.rest);
    this._showCutEdges(mesh.cutEdges);
    if (this.first === null && mesh.parts.outer?.positions.length > 0) {
      this.first = new Box3().setFromArray(mesh.parts.outer.positions);
    }
  }

  get geometries() {
    return [this.parts.outer.geometry, this.parts.cut.geometry];
  }

  /** Vertices and faces by kind, and points of the cut edges: for tests. */
  get counts() {
    const count = (mesh) => [
      mesh.geometry.attributes.position?.count ?? 0,
      (mesh.geometry.index?.count ?? 0) / 3,
    ];
    return {
      outer: count(this.parts.outer), cut: count(this.parts.cut), cutEdges: this._cutEdgePoints ?? 0,
    };
  }

  dispose() {
    this._scene.remove(this.group);
    for (const mesh of this.group.children) {
      mesh.geometry.dispose();
      mesh.material.dispose();
    }
  }

  _part(kind, { positions, faces }, rest) {
    const mesh = this.parts[kind];
    if (faces !== null) {
      mesh.geometry.dispose();
      mesh.geometry = new BufferGeometry();
      mesh.geometry.setAttribute('position', dynamic(positions.slice()));
      mesh.geometry.setIndex(new BufferAttribute(faces.slice(), 1));
      if (kind === 'outer') {
        mesh.geometry.setAttribute('normal', dynamic(new Float32Array(positions.length)));
        mesh.geometry.setAttribute('color', new BufferAttribute(mottle(positions), 3));
        mesh.geometry.setAttribute('uv', new BufferAttribute(rest.slice(), 2));
      } else {
        mesh.geometry.setAttribute('color', dynamic(new Float32Array(positions.length).fill(1)));
      }
      mesh.visible = faces.length > 0;
    } else {
      const known = mesh.geometry.attributes.position;
      if (known?.array.length !== positions.length) return; // whole meshes follow
      known.array.set(positions);
      known.needsUpdate = true;
    }
    if (kind === 'outer') smooth(mesh.geometry);
  }

  _showCutEdges(points) {
    const count = Math.floor(points.length / 6);
    this._cutEdgePoints = points.length / 3;
    this.cutEdges.visible = this.blood.visible = count > 0;
    if (count === 0) return;
    this._showBlood(points, count);
    shade(this.parts.cut.geometry, points);
    const { geometry } = this.cutEdges;
    if (geometry.index?.count !== 18 * count) {
      geometry.dispose();
      this.cutEdges.geometry = new BufferGeometry();
      this.cutEdges.geometry.setAttribute('position', dynamic(new Float32Array(18 * count)));
      this.cutEdges.geometry.setIndex(new BufferAttribute(prisms(count), 1));
    }
    const position = this.cutEdges.geometry.attributes.position;
    tubes(points, count, position.array);
    position.needsUpdate = true;
  }

  /** A flat band over each edge, upright to the mean normal of the surface near it. */
  _showBlood(points, count) {
    if (this.blood.geometry.index?.count !== 6 * count) {
      this.blood.geometry.dispose();
      const geometry = new BufferGeometry();
      geometry.setAttribute('position', dynamic(new Float32Array(12 * count)));
      geometry.setAttribute('normal', dynamic(new Float32Array(12 * count)));
      const uv = new Float32Array(8 * count), faces = new Uint32Array(6 * count);
      for (let i = 0; i < count; i += 1) {
        uv.set([0, 0, 0, 1, 1, 0, 1, 1], 8 * i);
        faces.set([0, 2, 1, 1, 2, 3].map((corner) => 4 * i + corner), 6 * i);
      }
      geometry.setAttribute('uv', new BufferAttribute(uv, 2));
      geometry.setIndex(new BufferAttribute(faces, 1));
      this.blood.geometry = geometry;
    }
    const { position, normal } = this.blood.geometry.attributes;
    bands(points, count, this.parts.outer.geometry, position.array, normal.array);
    position.needsUpdate = normal.needsUpdate = true;
  }

}

/** Lays the map over the mottled colour, in place of a product of both. */
function inked(shader) {
  shader.fragmentShader = shader.fragmentShader.replace('#include <map_fragment>', '').replace(
    '#include <color_fragment>',
    `#include <color_fragment>
    #ifdef USE_MAP
      vec4 ink = texture2D(map, vMapUv);
      diffuseColor.rgb = mix(diffuseColor.rgb, ink.rgb, ink.a);
    #endif`,
  );
}

/** A texture across the band: opaque in the middle, gone at its sides. */
function fadedBand() {
  const opacities = [[0, 0], [0.22, 0.22], [0.38, 0.85], [0.5, 1], [0.62, 0.85], [0.78, 0.22], [1, 0]];
  return fadedTexture(4, 64, (context) => context.createLinearGradient(0, 0, 0, 64),
    opacities.map(([at, opacity]) => [at, `rgba(255, 255, 255, ${opacity})`]));
}

/** Shares of the opened colour by the depth under the edges of the cut: pale rim, then darker. */
function shade(geometry, points) {
  const at = geometry.attributes.position?.array;
  if (!at || points.length === 0) return;
  if (geometry.attributes.color?.array.length !== at.length) {
    geometry.setAttribute('color', dynamic(new Float32Array(at.length)));
  }
  if (geometry.userData.shaded === geometry.index) return;
  geometry.userData.shaded = geometry.index;
  const colours = geometry.attributes.color.array;
  for (let i = 0; i < at.length; i += 3) {
    let least = Infinity;
    for (let k = 0; k < points.length; k += 6) {
      const x = at[i] - points[k], y = at[i + 1] - points[k + 1], z = at[i + 2] - points[k + 2];
      least = Math.min(least, x * x + y * y + z * z);
    }
    const depth = Math.sqrt(least);
    const dark = 1.15 - 0.8 * Math.min(1, depth / DEEP);
    for (let axis = 0; axis < 3; axis += 1) colours[i + axis] = depth < RIM ? FAT[axis] : dark;
  }
  geometry.attributes.color.needsUpdate = true;
}

function dynamic(array) {
  const attribute = new BufferAttribute(array, 3);
  attribute.setUsage(DynamicDrawUsage);
  return attribute;
}

/** Normals of a smooth surface, by the area of the faces around. */
function smooth(geometry) {
  const p = geometry.attributes.position.array;
  const n = geometry.attributes.normal.array;
  const faces = geometry.index.array;
  n.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
    const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    n[a] += x; n[a + 1] += y; n[a + 2] += z;
    n[b] += x; n[b + 1] += y; n[b + 2] += z;
    n[c] += x; n[c + 1] += y; n[c + 2] += z;
  }
  for (let i = 0; i < n.length; i += 3) {
    const norm = Math.hypot(n[i], n[i + 1], n[i + 2]) || 1;
    n[i] /= norm; n[i + 1] /= norm; n[i + 2] /= norm;
  }
  geometry.attributes.normal.needsUpdate = true;
}

/** Shares of the colour by place: an organ has several shades. Shape (n, 3). */
function mottle(positions) {
  const colours = new Float32Array(positions.length);
  for (let i = 0; i < positions.length; i += 3) {
    const x = 1e3 * positions[i], y = 1e3 * positions[i + 1], z = 1e3 * positions[i + 2];
    const wide = Math.sin(0.11 * x + 0.6 * Math.sin(0.07 * y)) * Math.cos(0.09 * y + 0.13 * z);
    const fine = Math.sin(0.9 * x + 1.3 * Math.sin(0.5 * y)) * Math.sin(0.8 * y + 0.6 * z);
    const by = 0.95 + 0.06 * wide + 0.025 * fine;
    colours[i] = by;
    colours[i + 1] = by - 0.045 * wide - 0.02;
    colours[i + 2] = by - 0.03 * wide - 0.01;
  }
  return colours;
}

/** Corners of a band over each segment, in the plane of the surface at the node that is nearest. */
function bands(points, count, { attributes }, out, normals) {
  const at = attributes.position.array, up = attributes.normal.array;
  const known = new Map(); // ends of segments are shared
  const upAt = (k) => {
    const key = `${points[k]},${points[k + 1]},${points[k + 2]}`;
    if (known.has(key)) return known.get(key);
    let best = 0, least = Infinity;
    for (let i = 0; i < at.length; i += 3) {
      const x = at[i] - points[k], y = at[i + 1] - points[k + 1], z = at[i + 2] - points[k + 2];
      const far = x * x + y * y + z * z;
      if (far < least) [least, best] = [far, i];
    }
    known.set(key, best);
    return best;
  };
  for (let i = 0; i < count; i += 1) {
    const s = 6 * i, a = upAt(s), b = upAt(s + 3);
    let nx = up[a] + up[b], ny = up[a + 1] + up[b + 1], nz = up[a + 2] + up[b + 2];
    const size = Math.hypot(nx, ny, nz) || 1;
    nx /= size; ny /= size; nz /= size;
    let x = points[s + 3] - points[s], y = points[s + 4] - points[s + 1], z = points[s + 5] - points[s + 2];
    const length = Math.hypot(x, y, z) || 1;
    x /= length; y /= length; z /= length;
    let cx = ny * z - nz * y, cy = nz * x - nx * z, cz = nx * y - ny * x;
    const across = BAND / (Math.hypot(cx, cy, cz) || 1);
    cx *= across; cy *= across; cz *= across;
    const longer = 0.35 * BAND;
    for (let corner = 0; corner < 4; corner += 1) {
      const end = corner < 2 ? s : s + 3, way = corner < 2 ? -longer : longer, side = corner % 2 ? 1 : -1;
      const to = 12 * i + 3 * corner;
      out[to] = points[end] + way * x + side * cx;
      out[to + 1] = points[end + 1] + way * y + side * cy;
      out[to + 2] = points[end + 2] + way * z + side * cz;
      normals[to] = nx; normals[to + 1] = ny; normals[to + 2] = nz;
    }
  }
}

/** Faces of tubes with three sides, six corners each. */
function prisms(count) {
  const faces = new Uint32Array(18 * count);
  for (let i = 0; i < count; i += 1) {
    const at = 6 * i;
    for (let side = 0; side < 3; side += 1) {
      const a = at + side, b = at + ((side + 1) % 3);
      faces.set([a, b, b + 3, a, b + 3, a + 3], 18 * i + 6 * side);
    }
  }
  return faces;
}

/** Corners of a tube around each segment, a little longer than it so that joints close. */
function tubes(points, count, out) {
  for (let i = 0; i < count; i += 1) {
    const s = 6 * i;
    let x = points[s + 3] - points[s], y = points[s + 4] - points[s + 1], z = points[s + 5] - points[s + 2];
    const length = Math.hypot(x, y, z) || 1;
    x /= length; y /= length; z /= length;
    // Two directions across, from the coordinate axis that is the least along.
    let ax, ay, az;
    if (Math.abs(z) < 0.8) [ax, ay, az] = [y, -x, 0];
    else [ax, ay, az] = [0, z, -y];
    const norm = Math.hypot(ax, ay, az) || 1;
    ax /= norm; ay /= norm; az /= norm;
    const bx = y * az - z * ay, by = z * ax - x * az, bz = x * ay - y * ax;
    for (let corner = 0; corner < 3; corner += 1) {
      const u = CORE_RADIUS * COS[corner], v = CORE_RADIUS * SIN[corner];
      const ox = u * ax + v * bx, oy = u * ay + v * by, oz = u * az + v * bz;
      const longer = 0.5 * CORE_RADIUS, at = 18 * i + 3 * corner;
      out[at] = points[s] + ox - longer * x;
      out[at + 1] = points[s + 1] + oy - longer * y;
      out[at + 2] = points[s + 2] + oz - longer * z;
      out[at + 9] = points[s + 3] + ox + longer * x;
      out[at + 10] = points[s + 4] + oy + longer * y;
      out[at + 11] = points[s + 5] + oz + longer * z;
    }
  }
}

const COS = [0, 1, 2].map((i) => Math.cos((2 * Math.PI * i) / 3));
const SIN = [0, 1, 2].map((i) => Math.sin((2 * Math.PI * i) / 3));
