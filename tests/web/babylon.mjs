// Loads a GLB with Babylon.js, without a picture, plays its animation and prints what stands where, as JSON.
// Usage: node babylon.mjs FILE FRACTION...   (moments of the animation, in [0, 1])
import "@babylonjs/loaders/glTF/2.0/index.js";
import { readFile } from "node:fs/promises";
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
import { NullEngine } from "@babylonjs/core/Engines/nullEngine.js";
import { LoadAssetContainerAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Scene } from "@babylonjs/core/scene.js";

// Babylon sorts splats in a worker, which nothing waits for where nothing is drawn.
globalThis.Worker = class {
  postMessage() {}
  terminate() {}
};

const [file, ...fractions] = process.argv.slice(2);
const scene = new Scene(new NullEngine());
scene.useRightHandedSystem = true; // as glTF's, so that no node is mirrored
new FreeCamera("camera", new Vector3(0, 0, 5), scene);
const container = await LoadAssetContainerAsync(new Uint8Array(await readFile(file)), scene, { pluginExtension: ".glb" });
container.addAllToScene();

const splatsOf = (mesh) => ({ count: mesh._vertexCount, means: Array.from(mesh._splatPositions ?? []).slice(0, 400) });
const shapes = container.meshes.map((mesh) => ({
  name: mesh.name,
  kind: mesh.getClassName(),
  vertices: mesh.getTotalVertices(),
  ...(mesh.getClassName() === "GaussianSplattingMesh" ? splatsOf(mesh) : {}),
}));

const moments = fractions.map(Number).map((fraction) => {
  const matrices = {};
  for (const group of container.animationGroups) {
    group.start().pause();
    group.goToFrame(group.from + fraction * (group.to - group.from));
  }
  for (const node of [...container.transformNodes, ...container.meshes]) {
    matrices[node.name] = Array.from(node.computeWorldMatrix(true).asArray());
  }
  return matrices;
});
const animations = container.animationGroups.map((group) => ({ name: group.name, targets: group.targetedAnimations.length }));
console.log(JSON.stringify({ shapes, animations, moments }));
process.exit(0);
