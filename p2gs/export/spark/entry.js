// What report_splats.js uses, as window.Spark.
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
window.Spark = { PerspectiveCamera, Scene, WebGLRenderer, SparkRenderer, SplatFileType, SplatMesh };
