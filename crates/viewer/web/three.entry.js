// Entry of three.min.js: three 0.187.0, licence in three.LICENSE. To make it again:
// npm install three@0.187.0 esbuild && npx esbuild three.entry.js --bundle --minify --format=esm --legal-comments=inline --outfile=three.min.js
export { ArrowHelper, BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, DirectionalLight, Fog, Group, HemisphereLight, Mesh, MeshStandardMaterial, PerspectiveCamera, Plane, Raycaster, Scene, SphereGeometry, Vector2, Vector3, WebGLRenderer } from 'three';
export { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
