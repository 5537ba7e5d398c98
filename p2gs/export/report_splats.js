// The Gaussians beside the mesh: Spark draws them, from the side and in the joint state that report_viewer.js tells of.
(async function () {
  "use strict";
  const canvas = document.getElementById("splats"), note = document.getElementById("splats-note");
  const bytesOf = (script) => Uint8Array.from(atob(script.textContent), (c) => c.charCodeAt(0));
  if (!window.DecompressionStream || !document.createElement("canvas").getContext("webgl2")) {
    note.textContent = "This browser is too old to show the Gaussians.";
    return;
  }
  const packed = new Blob([bytesOf(document.querySelector("script.spark"))]).stream().pipeThrough(new DecompressionStream("gzip"));
  const library = document.createElement("script");
  library.textContent = await new Response(packed).text();
  document.head.append(library);
  const { PerspectiveCamera, Scene, WebGLRenderer, SparkRenderer, SplatFileType, SplatMesh } = window.Spark;

  const renderer = new WebGLRenderer({ canvas, alpha: true, antialias: false, preserveDrawingBuffer: true });
  renderer.setClearColor(0, 0);
  const scene = new Scene(), camera = new PerspectiveCamera();
  camera.matrixAutoUpdate = false;
  let waiting = false;
  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; renderer.render(scene, camera); });
  }
  // 0.3 square pixels are what 3DGS widens every splat by, and what the twin was fitted with
  scene.add(new SparkRenderer({ renderer, onDirty: redraw, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false }));
  const meshes = {};
  for (const script of document.querySelectorAll("script.splats")) {
    const mesh = new SplatMesh({ fileBytes: bytesOf(script), fileType: SplatFileType.SPZ });
    mesh.matrixAutoUpdate = false;
    await mesh.initialized;
    scene.add(mesh);
    meshes[script.dataset.node] = mesh;
  }
  document.getElementById("view").addEventListener("shown", (e) => {
    const { eye, right, up, back, cotangent, near, far, models } = e.detail;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    renderer.setSize(width, height, false);
    camera.matrix.set(right[0], up[0], back[0], eye[0], right[1], up[1], back[1], eye[1], right[2], up[2], back[2], eye[2], 0, 0, 0, 1);
    camera.fov = (360 / Math.PI) * Math.atan(1 / cotangent);
    Object.assign(camera, { aspect: width / height, near, far });
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld(true);
    for (const [name, mesh] of Object.entries(meshes)) {
      mesh.matrix.fromArray(models[name]);
      mesh.updateMatrixWorld(true);
    }
    redraw();
  });
  canvas.dispatchEvent(new Event("ready")); // the mesh's viewer tells once more what it shows
})().catch((error) => {
  document.getElementById("splats-note").textContent = "The Gaussians cannot be shown in this browser: " + error.message;
  throw error;
});
