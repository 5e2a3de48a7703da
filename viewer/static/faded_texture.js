// Textures that fade, drawn on a canvas: nothing is loaded.

import { CanvasTexture, LinearFilter } from './vendor/three.module.min.js';

/**
 * Return a texture filled with a gradient.
 * @param {number} width [pixels] @param {number} height [pixels]
 * @param {function(CanvasRenderingContext2D): CanvasGradient} gradient without its stops
 * @param {Array<[number, string]>} stops of the gradient
 */
export function fadedTexture(width, height, gradient, stops) {
  const element = document.createElement('canvas');
  element.width = width;
  element.height = height;
  const context = element.getContext('2d');
  const fade = gradient(context);
  for (const [at, colour] of stops) fade.addColorStop(at, colour);
  context.fillStyle = fade;
  context.fillRect(0, 0, width, height);
  const texture = new CanvasTexture(element);
  texture.generateMipmaps = false;
  texture.minFilter = LinearFilter;
  return texture;
}
