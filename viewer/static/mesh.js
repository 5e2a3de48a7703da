// Decodes the binary message of a tissue: a header in JSON, then positions, faces, cut edges, and x and y at rest.

const KINDS = ['outer', 'cut'];

/** @returns {{name, revision, parts: Object<string, {positions, faces}>, cutEdges: Float32Array, rest: Float32Array}} */
export function decodeMesh(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  if (length > buffer.byteLength - 4) throw new RangeError('the header is longer than the message');
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  if (header.type !== 'mesh') throw new TypeError(`${header.type} is not known`);
  let at = 4 + length;
  at += -at & 3;
  const take = (kind, count) => {
    if (!Number.isInteger(count) || count < 0) throw new RangeError(`${count} values`);
    const values = new kind(buffer, at, count);
    at += values.byteLength;
    return values;
  };
  const parts = {};
  for (const part of header.parts) {
    if (!KINDS.includes(part.kind)) throw new TypeError(`part ${part.kind} is not known`);
    const positions = take(Float32Array, 3 * part.vertices);
    const faces = part.faces === null ? null : take(Uint32Array, 3 * part.faces);
    parts[part.kind] = { positions, faces };
  }
  const cutEdges = take(Float32Array, 3 * (header.cut_edges ?? 0));
  const rest = take(Float32Array, 2 * (header.rest ?? 0));
  return { name: header.name, revision: header.revision, parts, cutEdges, rest };
}
