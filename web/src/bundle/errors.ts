/** What is wrong with a file, in words for a person. */
export class BundleError extends Error {
  constructor(readonly subject: string, readonly expected: string, readonly received: string, readonly remedy = "") {
    super(`${subject}: expected ${expected}, received ${received}${remedy ? `; ${remedy}` : ""}`);
    this.name = "BundleError";
  }
}

export const EXPORT_AGAIN = "export the avatar anew with smplxpp export";
