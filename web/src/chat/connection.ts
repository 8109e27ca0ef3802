/** The websocket to the page's server, which is opened again when it is lost. */

/** Seconds until it is tried again: each time longer. */
const FIRST = 0.5, LONGEST = 8;
/** The server's codes of a conversation that another page has taken over, and of one that finds all places taken. */
const REPLACED = 4001, TAKEN = 4002;

/** What the server tells: an object with a kind. */
export interface Told {
  kind: string;
  [name: string]: unknown;
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

  constructor(private readonly secret: string) {}

  get open(): boolean {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  connect(): void {
    if (this.closed) return;
    // Beside the page, which may lie in a folder of a proxy, and as safe as the page.
    const address = new URL(this.secret, location.href);
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
      setTimeout(() => this.connect(), 1000 * this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST);
    };
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
