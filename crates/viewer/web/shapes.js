// Geometries of shapes. One geometry holds all shapes of a body, with the colour of each corner.
import {
  BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, Mesh, SphereGeometry,
} from 'three';

// Sides of a cylinder.
const SIDES = 28;
// Colours (sRGB) of shapes that were sent without one: the base, and the links.
const BASE = [0.42, 0.45, 0.5];
const LINK = [0.68, 0.71, 0.75];

// Places body or shape at the numbers from `at` on: position, then quaternion w, x, y, z.
export function place(object, pose, at) {
  object.position.set(pose[at], pose[at + 1], pose[at + 2]);
  object.quaternion.set(pose[at + 4], pose[at + 5], pose[at + 6], pose[at + 3]);
}

function ofTriangles(corners, normals) {
  const made = new BufferGeometry();
  made.setAttribute('position', new BufferAttribute(new Float32Array(corners), 3));
  if (normals) made.setAttribute('normal', new BufferAttribute(new Float32Array(normals), 3));
  else made.computeVertexNormals();
  return made;
}

// Round at the side and sharp at the ends. It lies along z.
function cylinder(radius, half) {
  const [corners, normals] = [[], []];
  const at = (side) => { const angle = (2 * Math.PI * side) / SIDES; return [Math.cos(angle), Math.sin(angle)]; };
  for (let side = 0; side < SIDES; side += 1) {
    const [[x, y], [u, v]] = [at(side), at(side + 1)];
    const rim = (a, b, z) => [radius * a, radius * b, z];
    corners.push(...rim(x, y, -half), ...rim(u, v, -half), ...rim(u, v, half));
    corners.push(...rim(x, y, -half), ...rim(u, v, half), ...rim(x, y, half));
    normals.push(x, y, 0, u, v, 0, u, v, 0, x, y, 0, u, v, 0, x, y, 0);
    corners.push(0, 0, half, ...rim(x, y, half), ...rim(u, v, half));
    corners.push(0, 0, -half, ...rim(u, v, -half), ...rim(x, y, -half));
    normals.push(0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, -1, 0, 0, -1);
  }
  return ofTriangles(corners, normals);
}

function geometry(shape) {
  const [a, b, c] = shape.size;
  if (shape.kind === 'box') return new BoxGeometry(2 * a, 2 * b, 2 * c).toNonIndexed();
  if (shape.kind === 'sphere') return new SphereGeometry(a, 24, 16).toNonIndexed();
  if (shape.kind === 'cylinder') return cylinder(a, b);
  if (shape.kind === 'convex') return ofTriangles(shape.mesh.faces.flat().flatMap((point) => shape.mesh.points[point]));
  // Capsules of three.js lie along y, those of a robot along z.
  return new CapsuleGeometry(a, 2 * b, 8, 20).rotateX(Math.PI / 2).toNonIndexed();
}

// The shapes of a body in one geometry.
export function bodyGeometry(shapes, body) {
  const parts = { position: [], normal: [], color: [] };
  for (const shape of shapes.filter((each) => each.body === body)) {
    const mesh = new Mesh(geometry(shape));
    place(mesh, shape.offset, 0);
    mesh.updateMatrix();
    mesh.geometry.applyMatrix4(mesh.matrix);
    const colour = new Color().setRGB(...(shape.colour ?? (body === 0 ? BASE : LINK)), 'srgb');
    const { position, normal } = mesh.geometry.attributes;
    parts.position.push(position.array);
    parts.normal.push(normal.array);
    parts.color.push(Float32Array.from({ length: position.array.length }, (_, at) => [colour.r, colour.g, colour.b][at % 3]));
  }
  const joined = new BufferGeometry();
  for (const [name, arrays] of Object.entries(parts)) {
    const all = new Float32Array(arrays.reduce((length, array) => length + array.length, 0));
    let at = 0;
    for (const array of arrays) { all.set(array, at); at += array.length; }
    joined.setAttribute(name, new BufferAttribute(all, 3));
  }
  return joined;
}

// Tiles of 0.5 m in two greys, so that motion over them is visible.
const TILE = 0.5;
const TILES = [[0.60, 0.64, 0.67], [0.67, 0.71, 0.74]].map((colour) => new Color().setRGB(...colour, 'srgb'));

// Ground of pairs of triangles; the first two corners of the second one are on the diagonal of the pair.
function tiled(corners) {
  const made = ofTriangles(corners);
  const colours = new Float32Array(corners.length);
  for (let at = 0; at < corners.length; at += 18) {
    const middle = (axis) => (corners[at + axis] + corners[at + 3 + axis] + corners[at + 6 + axis] + corners[at + 15 + axis]) / 4;
    const tile = TILES[Math.abs(Math.floor(middle(0) / TILE) + Math.floor(middle(1) / TILE)) % 2];
    for (let corner = 0; corner < 18; corner += 3) colours.set([tile.r, tile.g, tile.b], at + corner);
  }
  made.setAttribute('color', new BufferAttribute(colours, 3));
  return made;
}

// Corners of a tile at the index (i, j) of a square of `count` times `count` tiles around the origin.
function levelTile(count, i, j, z) {
  const [x, y] = [i, j].map((index) => TILE * (index - count / 2));
  return [x, y, z, x + TILE, y, z, x + TILE, y + TILE, z, x, y, z, x + TILE, y + TILE, z, x, y + TILE, z];
}

// A square of `count` times `count` tiles in z = 0.
export function levelGround(count) {
  const corners = [];
  for (let i = 0; i < count; i += 1) for (let j = 0; j < count; j += 1) corners.push(...levelTile(count, i, j, 0));
  return tiled(corners);
}

// A height field, and level tiles around it, as in the simulation.
export function fieldGround({ shape: [rows, columns], origin, cell_size: cell, heights }, count) {
  const corners = [];
  const point = (i, j) => [origin[0] + i * cell, origin[1] + j * cell, heights[i * columns + j]];
  for (let i = 0; i + 1 < rows; i += 1) {
    for (let j = 0; j + 1 < columns; j += 1) {
      const [a, b, c, d] = [point(i, j), point(i + 1, j), point(i + 1, j + 1), point(i, j + 1)];
      corners.push(...a, ...b, ...d, ...d, ...b, ...c);
    }
  }
  const size = [rows, columns].map((points) => (points - 1) * cell);
  for (let i = 0; i < count; i += 1) {
    for (let j = 0; j < count; j += 1) {
      const middle = [i, j].map((index) => TILE * (index + 0.5 - count / 2));
      const isInside = middle.every((at, axis) => at > origin[axis] && at < origin[axis] + size[axis]);
      if (!isInside) corners.push(...levelTile(count, i, j, heights[0]));
    }
  }
  return tiled(corners);
}
