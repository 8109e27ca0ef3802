/** What the player uses of WebXR, which TypeScript's library does not know. */

export interface XRSystem {
  isSessionSupported(mode: string): Promise<boolean>;
  requestSession(mode: string, options: { optionalFeatures: string[] }): Promise<XRSession>;
}

export interface XRSession {
  requestReferenceSpace(kind: string): Promise<unknown>;
  updateRenderState(state: { baseLayer: XRLayer; depthNear: number }): Promise<void> | void;
  requestAnimationFrame(callback: (now: number, frame: XRFrame) => void): number;
  addEventListener(kind: "end", listener: () => void): void;
  end(): Promise<void>;
}

export interface XRFrame {
  getViewerPose(space: unknown): { transform: XRTransform; views: XRView[] } | undefined;
}

/** A place in the reference space: column-major 4 x 4; its inverse takes the space to it. */
export interface XRTransform {
  matrix: Float32Array;
  inverse: { matrix: Float32Array };
}

export interface XRView {
  transform: XRTransform;
  /** Column-major, OpenGL's axes and clip space. */
  projectionMatrix: Float32Array;
}

export interface XRLayer {
  framebuffer: WebGLFramebuffer | null;
  getViewport(view: XRView): { x: number; y: number; width: number; height: number } | null;
}

type LayerMaker = new (session: XRSession, gl: WebGL2RenderingContext, options: Record<string, boolean>) => XRLayer;

/** The browser's own, or null where it has none. */
export function system(): XRSystem | null {
  return (navigator as Navigator & { xr?: XRSystem }).xr ?? null;
}

/** The pixels of a session. */
export function makeLayer(session: XRSession, gl: WebGL2RenderingContext): XRLayer {
  const { XRWebGLLayer } = window as unknown as { XRWebGLLayer: LayerMaker };
  return new XRWebGLLayer(session, gl, { antialias: false, depth: false, alpha: false });
}
