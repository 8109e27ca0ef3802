/** The websocket to the page's server, which is opened again when it is lost. */

/** Seconds until it is tried again: each time longer. How long the page may take, milliseconds. */
const FIRST = 0.5, LONGEST = 8, PATIENCE = 10_000;
/** The server's codes of a conversation that another page has taken over, and of one that finds all places taken. */
const REPLACED = 4001, TAKEN = 4002;
const FORBIDDEN = 403;

/** What the server tells: an object with a kind. */
export interface Told {
  kind: string;
  [name: string]: unknown;
}

/**
 * The address of a server's socket, which its page alone knows.
 *
 * @throws Error no such server, or one that asks for a token.
 */
export async function socketOf(page: URL, signal: AbortSignal): Promise<URL> {
  const reply = await fetch(page, { signal }), text = await reply.text();
  const secret = new DOMParser().parseFromString(text, "text/html").body.getAttribute("data-chat");
  if (reply.ok && secret) return new URL(secret, page);
  const received = reply.ok ? "another page" : `${reply.status} ${text.slice(0, 200)}`;
  throw new Error(`${page}: expected the page of smplxpp chat --serve, received ${received}`, { cause: reply.status });
}

export class Connection {
  onopen: () => void = () => {};
  /** It is gone; `final`: for good. */
  onlost: (final: boolean) => void = () => {};
  ontold: (told: Told) => void = () => {};
  onframes: (data: ArrayBuffer) => void = () => {};
  private socket: WebSocket | null = null;
  private wait = FIRST;
  private closed = false;

  /** @param address of the socket, beside the page of the server: as safe as that, and perhaps in a folder of a proxy. */
  constructor(private address: URL, private readonly page: URL) {}

  get open(): boolean {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  connect(): void {
    if (this.closed) return;
    const address = new URL(this.address);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.wait = FIRST;
      this.onopen();
    };
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      if (typeof data === "string") this.ontold(JSON.parse(data) as Told);
      else this.onframes(data);
    };
    socket.onclose = ({ code, reason }) => {
      if (this.closed) return;
      const final = code === REPLACED;
      this.onlost(final);
      if (code === TAKEN) this.ontold({ kind: "note", text: `${reason}; this page waits for its turn.` });
      if (final) return;
      this.later();
    };
  }

  /** Tries again: a server that was started anew has another address for its socket. */
  private later(): void {
    setTimeout(() => {
      if (this.closed) return;
      socketOf(this.page, AbortSignal.timeout(PATIENCE)).then((address) => {
        this.address = address;
        this.connect();
      }, (error: Error) => {
        if (error.cause === FORBIDDEN) this.ontold({ kind: "note", text: error.message });
        this.later();
      });
    }, 1000 * this.wait);
    this.wait = Math.min(2 * this.wait, LONGEST);
  }

  /** Ends it for good; nothing is told any more. */
  close(): void {
    this.closed = true;
    this.socket?.close();
  }

  /** Sends, if there is somebody: an object, or samples. */
  send(message: object | Int16Array): boolean {
    if (!this.open) return false;
    this.socket!.send(message instanceof Int16Array ? message as Int16Array<ArrayBuffer> : JSON.stringify(message));
    return true;
  }
}
