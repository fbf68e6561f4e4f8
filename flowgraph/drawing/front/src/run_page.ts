import uPlot from "uplot";
import * as THREE from "three";
console.log(uPlot, THREE.Vector3);
