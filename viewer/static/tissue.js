// One tissue in the scene: its outside, the cut faces, and a line along the edges of the cuts.

import {
  Box3, BufferAttribute, BufferGeometry, DynamicDrawUsage, Group, Mesh, MeshBasicMaterial,
  MeshPhongMaterial, SRGBColorSpace,
} from './vendor/three.module.min.js';

const OPENED = 0x8a0614;
const CUT_EDGE = 0x5c0410;
const CUT_EDGE_RADIUS = 0.00045; // [m]

export class TissueView {
  constructor(scene) {
    this.group = new Group();
    const looks = {
      outer: { vertexColors: true, specular: 0x4a3a38, shininess: 46 },
      cut: { color: OPENED, specular: 0x401014, shininess: 70, flatShading: true, side: 2 },
    };
    this.parts = {};
    for (const [kind, look] of Object.entries(looks)) {
      const mesh = new Mesh(new BufferGeometry(), new MeshPhongMaterial(look));
      mesh.frustumCulled = false;
      mesh.visible = false;
      this.group.add(mesh);
      this.parts[kind] = mesh;
    }
    this.cutEdges = new Mesh(new BufferGeometry(), new MeshBasicMaterial({ color: CUT_EDGE }));
    this.cutEdges.frustumCulled = false;
    this.group.add(this.cutEdges);
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
    for (const [kind, part] of Object.entries(mesh.parts)) this._part(kind, part);
    this._showCutEdges(mesh.cutEdges);
    if (this.first === null && mesh.parts.outer?.positions.length > 0) {
      this.first = new Box3().setFromArray(mesh.parts.outer.positions);
    }
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

  _part(kind, { positions, faces }) {
    const mesh = this.parts[kind];
    if (faces !== null) {
      mesh.geometry.dispose();
      mesh.geometry = new BufferGeometry();
      mesh.geometry.setAttribute('position', dynamic(positions.slice()));
      mesh.geometry.setIndex(new BufferAttribute(faces.slice(), 1));
      if (kind === 'outer') {
        mesh.geometry.setAttribute('normal', dynamic(new Float32Array(positions.length)));
        mesh.geometry.setAttribute('color', new BufferAttribute(mottle(positions), 3));
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
    this.cutEdges.visible = count > 0;
    if (count === 0) return;
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
      const u = CUT_EDGE_RADIUS * COS[corner], v = CUT_EDGE_RADIUS * SIN[corner];
      const ox = u * ax + v * bx, oy = u * ay + v * by, oz = u * az + v * bz;
      const longer = 0.5 * CUT_EDGE_RADIUS, at = 18 * i + 3 * corner;
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
