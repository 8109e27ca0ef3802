// An avatar as a React component: mounted, unmounted and mounted again (StrictMode does) it leaves nothing behind.
import { useEffect, useImperativeHandle, useRef } from "react";
import { createAvatar } from "smplxpp-player";

export function Avatar({ ref, url, lips, voice, view = "whole", background = null, parts, onReady, onError, ...rest }) {
  const canvas = useRef(null), avatar = useRef(null), heard = useRef({});
  heard.current = { onReady, onError };

  useEffect(() => {
    const it = createAvatar(canvas.current, { url, lips, voice, view, background });
    avatar.current = it;
    it.on("ready", (summary) => heard.current.onReady?.(summary));
    it.on("error", (error) => heard.current.onError?.(error));
    return () => it.dispose();
  }, [url, lips, voice]);
  // What `set` takes changes without opening the file again.
  useEffect(() => {
    avatar.current.set({ background, view, ...(parts && { parts }) }).catch((error) => heard.current.onError?.(error));
  }, [background, view, parts]);
  useImperativeHandle(ref, () => ({
    say: (what) => avatar.current.say(what), pose: (params) => avatar.current.pose(params), converse: (server) => avatar.current.converse(server),
  }), []);
  return <canvas ref={canvas} {...rest} />;
}
