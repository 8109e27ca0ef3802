/** Bytes from wherever a page has them. */

/** An address, a file, or bytes that are taken: they belong to the avatar from then on. */
export type Source = string | URL | Blob | ArrayBuffer;

/** @throws Error why they cannot be had. */
export async function bytesOf(source: Source, signal?: AbortSignal): Promise<ArrayBuffer> {
  if (source instanceof ArrayBuffer) return source;
  if (source instanceof Blob) return source.arrayBuffer();
  const address = String(source), absolute = new URL(address, document.baseURI);
  // Browsers refuse pages from disk the files beside them, with an error that does not tell why.
  if (absolute.protocol === "file:")
    throw new Error("This page was opened from disk, where a browser does not let it read the files beside it. " +
      "Serve its folder (smplxpp web --serve, or python -m http.server), or make one file with smplxpp web --single-file.");
  const reply = await fetch(absolute, { signal }).catch((error: Error) => {
    if (signal?.aborted) throw error;
    throw new Error(`${address}: ${error.message}` +
      (absolute.origin !== location.origin ? ". Another site must allow it by Access-Control-Allow-Origin (CORS)." : ""));
  });
  if (!reply.ok) throw new Error(`${address}: the server says ${reply.status} ${reply.statusText}`);
  return reply.arrayBuffer();
}
