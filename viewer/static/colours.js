// Colours of what is drawn; the page sends those of the tissues' outside (viewer/colours.py).

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
