// Colours of what is drawn; the page sends those of the tissues' outside (viewer/appearance.py).

// Cut
export const OPENED = 0xa30a18; // cut faces, deep inside
export const FAT = [1.75, 5.5, 3.6]; // their pale rim under the skin, in parts of OPENED
export const CORE = 0x2a0206; // between the lips
export const BLOOD = 0xb00012; // beside the lips

// Tool
export const BLADE = 0xc9d2da;
export const HANDLE = 0x3a4552;
export const PROXY = 0x1fb47f;
export const FORCE = 0x56b4e9;
export const GHOST = 0xffd166; // of a tool that follows another

// Line from the tip to the surface
export const ABOVE = 0xe8f1f8, BELOW = 0xffd166;

// Exercise: ink on the tissue
export const TARGET = '#0a3d91'; // line to be cut
export const BAND = 'rgba(255, 246, 228, 0.42)', BAND_EDGE = 'rgba(255, 250, 240, 0.9)'; // its margin
export const ZONE = 'rgba(250, 200, 0, 0.62)', HATCH = 'rgba(20, 12, 4, 0.9)'; // not to be cut
export const LESION = 'rgba(70, 40, 60, 0.45)', DOTS = 'rgba(36, 14, 40, 0.9)';
export const ENDS = 0xf4f8fb; // of the tip's way
export const ATTACHED = 0x7dffb0; // around the last tissue that holds a lesion
